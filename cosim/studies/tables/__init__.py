"""What studies print.

* ``numbers``, ``wall_time``: figures with their intervals, as texts.
* ``show``: what is printed of a study.
* ``study``: a study as a whole; ``metric``, ``member``: one of them.
* ``basis``, ``correlations``: what intervals rest on; what metrics go with.
* ``groups``: statistics for each value of a key.
* ``sensitivity``: Sobol indices.
"""
