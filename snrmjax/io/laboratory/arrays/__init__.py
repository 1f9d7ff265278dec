"""Files of named arrays (MATLAB, HDF5, netCDF), interpreted by names and shapes."""
