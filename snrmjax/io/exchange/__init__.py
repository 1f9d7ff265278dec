"""Between laboratories' files and our tables: what a file holds, maps, imports and exports."""
