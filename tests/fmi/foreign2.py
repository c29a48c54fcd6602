from pythonfmu import Boolean, Fmi2Causality, Fmi2Slave, Fmi2Variability, Integer, Real


class Foreign2(Fmi2Slave):
    """The plant (28) as pythonfmu sees it: no dependencies, no states.

    Inputs with a zero-order hold, one Runge-Kutta step a communication step.
    """

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.u = self.delta = 0.0
        self.x1 = 1.0
        self.x2 = -1.0
        self.limit = 1e9
        self.steps = 0
        self.late = False
        self.gain = 1
        self.sign = True
        given = {"causality": Fmi2Causality.input}
        output = {"causality": Fmi2Causality.output}
        tunable = {
            "causality": Fmi2Causality.parameter,
            "variability": Fmi2Variability.tunable,
        }
        self.register_variable(Real("u", **given))
        self.register_variable(Real("delta", **given))
        self.register_variable(Real("y", getter=lambda: self.x1 - self.u, **output))
        self.register_variable(Real("x_a[1]", getter=lambda: self.x1, **output))
        self.register_variable(Real("x_a[2]", getter=lambda: self.x2, **output))
        self.register_variable(Real("x_b", getter=lambda: -self.x1 - self.u, **output))
        self.register_variable(Integer("steps", **output))
        self.register_variable(Boolean("late", **output))
        self.register_variable(Integer("gain", **given))
        self.register_variable(Boolean("sign", **given))
        self.register_variable(Real("limit", **tunable))

    def rates(self, x1, x2):
        rate1 = -x1 + x2 - self.u + self.delta
        rate2 = -x1 - 2.0 * x2 + self.u
        return rate1, rate2

    def do_step(self, t, h):
        if t + h > self.limit + 1e-9:
            if self.limit > 0.1:
                raise ValueError("beyond the limit")
            return False
        a1, a2 = self.rates(self.x1, self.x2)
        b1, b2 = self.rates(self.x1 + 0.5 * h * a1, self.x2 + 0.5 * h * a2)
        c1, c2 = self.rates(self.x1 + 0.5 * h * b1, self.x2 + 0.5 * h * b2)
        d1, d2 = self.rates(self.x1 + h * c1, self.x2 + h * c2)
        self.x1 += h / 6.0 * (a1 + 2.0 * b1 + 2.0 * c1 + d1)
        self.x2 += h / 6.0 * (a2 + 2.0 * b2 + 2.0 * c2 + d2)
        self.steps += self.gain if self.sign else -self.gain
        self.late = self.steps > 3
        return True
