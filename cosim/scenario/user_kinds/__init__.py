"""Component kinds of users: a class by its name, its parameters, installed packages."""
