"""Dead time of clocked and free-running detectors: renewal chains, means, draws, likelihoods and inverses."""
