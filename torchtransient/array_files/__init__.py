"""Arrays and entries by name in HDF5 and `.npz`: written whole, sealed with checksums, and read within bounds."""
