"""C kernels and their ctypes binding.

Each C file has a header of its name, and most have a Python file with their structs. In folders::

    stages/      components that advance together in one call
    numerics/    linear algebra, elementary functions, expressions in t, Runge-Kutta methods, noise
    blocks/      the steps of components: sources, functions, controllers, sensors, wrappers
    estimation/  the steps of estimators: regression, Kalman filters, output error
    fmi/         loaded FMUs, called by address

``cosim.h`` and ``step.py`` hold the native step, which all of them have in common; ``library.py``
loads what ``build.py`` compiles at installation. Entered once per block of communication steps.
"""
