"""What every room stands on: console, files, records of JSON and TOML, worker processes."""
