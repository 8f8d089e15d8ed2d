"""Basics that every other package uses: console, files, limits, records of JSON and TOML, worker processes."""
