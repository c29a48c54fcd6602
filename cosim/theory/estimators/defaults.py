"""Default settings of the estimators: who shows them loads none of the methods."""

from __future__ import annotations

from typing import Final

# Of 0.1, 0.2, 0.5, 1, ..., 1e5 those between 1 and 5 leave the least error of eta in the paper's
# example without noise; from 2 on eta belongs to no theta.
GRADIENT_GAIN: Final = 1.0  # 1/s

# Of 1, 2, 5, ..., 50 s and 0.1, 1, ..., 1e3 1/s, in the paper's example without noise: what forgets
# sooner than 10 s is worse, what forgets later is not better by more than 3e-4; from 10 1/s on the
# gain no longer matters.
DREM_FORGETTING: Final = 20.0  # s
DREM_GAIN: Final = 10.0  # 1/s

AUGMENTED_DEVIATION: Final = 1e-3
AUGMENTED_INTENSITY: Final = 1.0

# Of 3e-4, 1e-3, ..., 0.3 and 0.3, 1, 3, in the paper's example over 8 seeds of noise of 1e-3 and
# without noise: the deviation of the noise itself loses theta in one of 8 seeds, 0.01 ends 10 of
# its standard errors off; with 0.1, which pays for what the linearization errs, the error is
# within them.
EXTENDED_DEVIATION: Final = 0.1
KALMAN_SIZE: Final = 1.0  # of both filters
