"""In front of the pixels: photon budget, lens blur, analyzers."""
