"""Pixels that integrate: their electronics and gates."""
