"""Disturbances of the class (4)-(5): families, the regression, what data can tell apart."""
