"""Images to look at: exposure and colour, looks, PNG, JPEG and videos, and stacks in notebooks."""
