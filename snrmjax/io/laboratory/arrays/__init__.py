"""Files of named arrays: MATLAB, HDF5, netCDF, and what their names and shapes say."""
