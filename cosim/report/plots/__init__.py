"""Pictures of runs; they need the extra ``[plot]``.

* ``picture``: figure, panels, colors, format and file.
* ``runs``: curves of recorded signals, and pictures of runs.
* ``identification``: the picture of an identification from logs.
"""
