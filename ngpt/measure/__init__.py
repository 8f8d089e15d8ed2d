"""How good an image is: metrics, perceptual distances, and the advice that is made of measurements."""
