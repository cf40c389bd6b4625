"""What every sensing module has to keep, the entries of the modules, and an oracle that walks photon by photon."""
