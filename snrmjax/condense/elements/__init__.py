"""Built-in finite elements: plane beams and arches with large displacements and rotations."""
