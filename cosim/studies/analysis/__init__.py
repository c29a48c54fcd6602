"""What the columns of a study say: statistics, convergence, sensitivity.

* ``columns``: members, parameters and metrics as arrays, with what has no value.
* ``independence``: which members were drawn independently: what every interval rests on.
* ``confidence``: intervals of a mean, a standard deviation, a quantile, a proportion.
* ``statistics``, ``conditions``, ``convergence``, ``extremes``, ``correlation``: of a metric.
* ``ranks``: what the correlation of ranks and its deviation are computed of.
* ``groups``: statistics for each value of a key.
* ``failures``: the members that failed, by reason.
* ``sensitivity``: Sobol indices.
* ``results``: all of this of the dataset of a study.
"""
