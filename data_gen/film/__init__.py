"""The film: statistics of the samples of every pixel, in constant memory, and the layers they develop into."""

from data_gen.film.gradient_film import DISCARDED, SHIFTS, GradientFilm

__all__ = ["DISCARDED", "SHIFTS", "GradientFilm"]
