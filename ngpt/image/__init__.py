"""Images to look at: exposure, colour, view transforms, PNG, JPEG, videos, and stacks in notebooks."""
