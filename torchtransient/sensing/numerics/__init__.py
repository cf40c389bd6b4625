"""Random draws of whole histograms, convolutions and running sums along time."""
