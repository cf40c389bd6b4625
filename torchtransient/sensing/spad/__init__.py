"""Single-photon avalanche diodes: in step with the laser, running free, as binary frames."""
