"""The former name of ``data_gen.frames.shot``, for callers that are on their way to it."""

from data_gen.frames.shot import Shot as Shot
from data_gen.frames.shot import render_shot as render_sequence  # noqa: F401
