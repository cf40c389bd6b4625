"""The sweep of gradients: every parameter of every plugin, bare and inside others, against finite differences.

``make sweep`` runs it (``python -m tools.gradient_sweep``) and writes ``docs/gradients_sweep.md``.
"""
