"""What is drawn: canvas, scene, camera, shading, legend, pictures, animation."""
