"""Spectra of beats, as coherent (FMCW) lidars measure them: speckle, noise of the local oscillator, range and speed."""
