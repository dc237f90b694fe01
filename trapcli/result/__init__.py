"""The result: the `Motion` data type, its HDF5 file, comparison and export."""
