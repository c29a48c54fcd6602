from pythonfmu3 import (
    CoSimulation,
    Float64,
    Fmi3Causality,
    Fmi3Initial,
    Fmi3SlaveBase,
    Fmi3Variability,
    ModelExchange,
)


class Foreign3(Fmi3SlaveBase, ModelExchange, CoSimulation):
    """The plant (28) as pythonfmu3 sees it: model exchange and co-simulation.

    Co-simulation is Heun's method with a zero-order hold of the inputs.
    """

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.time = self.u = self.delta = 0.0
        self.x1 = 1.0
        self.x2 = -1.0
        self.der1 = self.der2 = 0.0
        moving = {"variability": Fmi3Variability.continuous}
        output = {"causality": Fmi3Causality.output, **moving}
        local = {"causality": Fmi3Causality.local, **moving}
        self.register_variable(Float64("time", causality=Fmi3Causality.independent, **moving))
        self.register_variable(Float64("u", causality=Fmi3Causality.input, **moving))
        self.register_variable(Float64("delta", causality=Fmi3Causality.input, **moving))
        self.register_variable(Float64("x1", start=1, initial=Fmi3Initial.exact, **output))
        self.register_variable(Float64("der1", derivative=3, **local))
        self.register_variable(Float64("x2", start=-1, initial=Fmi3Initial.exact, **output))
        self.register_variable(Float64("der2", derivative=5, **local))
        self.register_variable(Float64("y", getter=lambda: self.x1 - self.u, **output))

    def get_continuous_state_derivatives(self):
        self.der1 = -self.x1 + self.x2 - self.u + self.delta
        self.der2 = -self.x1 - 2.0 * self.x2 + self.u
        return [self.der1, self.der2]

    def do_step(self, t, h):
        x1 = self.x1
        x2 = self.x2
        a1, a2 = self.get_continuous_state_derivatives()
        self.x1 = x1 + h * a1
        self.x2 = x2 + h * a2
        b1, b2 = self.get_continuous_state_derivatives()
        self.x1 = x1 + 0.5 * h * (a1 + b1)
        self.x2 = x2 + 0.5 * h * (a2 + b2)
        return True
