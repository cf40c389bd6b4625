"""Samples of data sets on disk: shard files that appear whole or not at all, their manifest, and exports."""
