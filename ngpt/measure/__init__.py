"""How good an image is: metrics, perceptual distances, and what one more layer would buy."""
