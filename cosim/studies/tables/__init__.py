"""What studies print.

* ``numbers``: figures with their intervals, as texts.
* ``study``: a study as a whole; ``metric``, ``member``: one of them.
* ``sensitivity``: Sobol indices.
"""
