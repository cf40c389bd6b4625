"""Back from what was measured: depth from histograms, its Cramer-Rao bound, transposes of sensors."""
