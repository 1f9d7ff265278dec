"""Built-in finite elements: beams and arches in a plane, with large displacements and rotations."""
