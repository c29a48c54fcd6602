"""Components made of the theory and the core: sources, plant, observer, regressor, identifier, controller, and small parts."""
