"""Unknown-input observers: when they exist, how they are designed, which assumptions hold."""
