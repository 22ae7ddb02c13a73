"""The packaged scenarios, one TOML file each, and the catalog that finds them by name."""
