"""Pictures of runs; they need the extra ``[plot]``.

* ``picture``: figure, panels, colors, format and file.
* ``curves``: what is drawn into a panel, with names, units and bands.
* ``runs``, ``identification``, ``schedule``: the pictures.
"""
