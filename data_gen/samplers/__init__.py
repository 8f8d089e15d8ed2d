"""The samplers: what renders the layers of a gradient stack."""
