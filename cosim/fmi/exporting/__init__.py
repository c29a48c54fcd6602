"""Our models and components as FMUs: descriptions, C sources, binaries."""
