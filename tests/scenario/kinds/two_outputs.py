"""A plant with two outputs, and an identifier of its disturbance."""

SCENARIO = """
[scenario]
name = "two-sensors"
stop = 20.0
step = 1e-2
[models.academic]
n_a = 2
A = [[0, 1, 1], [0, -2, 1], [1, 0, 1]]
Bu = [[0], [2], [1]]
Bd = [[1], [0], [0]]
C = [[2, 0, 1], [1, 0.5, 0]]
[components.u]
kind = "sine"
rate = 1.0
[components.delta]
kind = "disturbance"
terms = [
  { alpha = "1.35 + 0.25*sin(1.7*t)", family = "exponential", theta = -0.1 },
  { alpha = "1.10 + 0.20*cos(2.3*t)", family = "exponential", theta = -0.3 },
]
[components.plant]
kind = "descriptor"
model = "academic"
x_a0 = [1.0, -1.0]
[components.sensor]
kind = "sensor"
size = 2
noise = [0.1, 1e-3]
seed = 1
[components.observer]
kind = "unknown-input-observer"
model = "academic"
poles = [-4.0, -5.0]
filter_rate = 100.0
[components.regressor]
kind = "regressor"
terms = [
  { alpha = "1.35 + 0.25*sin(1.7*t)", family = "exponential" },
  { alpha = "1.10 + 0.20*cos(2.3*t)", family = "exponential" },
]
delays = [1.0, 2.0, 3.0]
[components.identifier]
kind = "identifier"
method = "output-error"
start = 4.0
period = 0.1
[connections]
"plant.u" = "u.y"
"plant.delta" = "delta.y"
"observer.u" = "u.y"
"sensor.u" = "plant.y"
"observer.y" = "sensor.y"
"regressor.delta" = "observer.delta"
"identifier.regressor" = "regressor.mu"
"""
