"""curvafit: read, make and enforce the shape texture of tubes and membranes in 3D."""
