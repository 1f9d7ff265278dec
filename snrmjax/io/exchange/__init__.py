"""Import of laboratory files into our tables: listings, maps, imports and exports."""
