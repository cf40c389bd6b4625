"""Closed forms and finite differences, for tests of renderers, plugins and gradients of your own.

`closed_forms` has transients of the scenes of `tt.scenes` and captures around a corner, and
`finite_differences` central differences with common random numbers. All take and return numpy arrays; tests of
independent runs are in `torchtransient.accuracy.statistics`.
"""
