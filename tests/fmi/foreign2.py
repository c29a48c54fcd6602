from pythonfmu import Boolean, Fmi2Causality, Fmi2Slave, Fmi2Variability, Integer, Real


class Foreign2(Fmi2Slave):
    """The plant (28) as pythonfmu sees it: held inputs, one Runge-Kutta step a communication step, no dependencies, no states."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.u = self.delta = 0.0
        self.x1, self.x2 = 1.0, -1.0
        self.limit = 1e9
        self.steps, self.late, self.gain, self.sign = 0, False, 1, True
        for name in ("u", "delta"):
            self.register_variable(Real(name, causality=Fmi2Causality.input))
        self.register_variable(
            Real("y", causality=Fmi2Causality.output, getter=lambda: self.x1 - self.u)
        )
        self.register_variable(
            Real("x_a[1]", causality=Fmi2Causality.output, getter=lambda: self.x1)
        )
        self.register_variable(
            Real("x_a[2]", causality=Fmi2Causality.output, getter=lambda: self.x2)
        )
        self.register_variable(
            Real("x_b", causality=Fmi2Causality.output, getter=lambda: -self.x1 - self.u)
        )
        self.register_variable(Integer("steps", causality=Fmi2Causality.output))
        self.register_variable(Boolean("late", causality=Fmi2Causality.output))
        self.register_variable(Integer("gain", causality=Fmi2Causality.input))
        self.register_variable(Boolean("sign", causality=Fmi2Causality.input))
        self.register_variable(
            Real("limit", causality=Fmi2Causality.parameter, variability=Fmi2Variability.tunable)
        )

    def rate(self, x1, x2):
        return -x1 + x2 - self.u + self.delta, -x1 - 2.0 * x2 + self.u

    def do_step(self, t, h):
        if t + h > self.limit + 1e-9:
            if self.limit > 0.1:
                raise ValueError("beyond the limit")
            return False
        a = self.rate(self.x1, self.x2)
        b = self.rate(self.x1 + 0.5 * h * a[0], self.x2 + 0.5 * h * a[1])
        c = self.rate(self.x1 + 0.5 * h * b[0], self.x2 + 0.5 * h * b[1])
        d = self.rate(self.x1 + h * c[0], self.x2 + h * c[1])
        self.x1 += h / 6.0 * (a[0] + 2.0 * b[0] + 2.0 * c[0] + d[0])
        self.x2 += h / 6.0 * (a[1] + 2.0 * b[1] + 2.0 * c[1] + d[1])
        self.steps += self.gain if self.sign else -self.gain
        self.late = self.steps > 3
        return True
