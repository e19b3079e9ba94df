"""How a microscope or scanner sees a shape: optics, noise, artefacts, and the modalities that join them."""
