"""OpenEXR: headers, files, and the layers of a stack in them, under any renderer's names."""
