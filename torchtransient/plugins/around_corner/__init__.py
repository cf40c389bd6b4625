"""Around the corner: what a scan of a relay wall looks at, where its laser falls, and light of three bounces."""
