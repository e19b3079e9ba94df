"""Training sets: cases from shapes and images, on disk or drawn as they are asked for."""
