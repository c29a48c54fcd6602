"""What studies print.

* ``numbers``: figures with their intervals, as texts.
* ``show``: what is printed of a study.
* ``study``: a study as a whole; ``metric``, ``member``: one of them.
* ``groups``: statistics for each value of a key.
* ``sensitivity``: Sobol indices.
"""
