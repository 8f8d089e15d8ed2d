"""What every room stands on: console, files, limits, records of JSON and TOML, worker processes."""
