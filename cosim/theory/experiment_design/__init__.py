"""The error of theta that is to be expected of an experiment, before it is made.

A record of the reconstructed disturbance without noise, and what white noise of y leaves in it,
decide what an estimator on the regression (25) will find: its expected equation has a root of its
own, the bias, and the noise moves that root, the covariance. For output error it is the Cramer-Rao
bound of y. Delays, filter and step are compared by that.
"""
