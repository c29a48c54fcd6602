"""A scenario with one component of every kind that depends on no file."""

PARTS = """
[scenario]
name = "parts"
stop = 1.0
step = 0.1
[components]
constant = { kind = "constant", value = 1.0 }
step = { kind = "step", time = 0.5 }
ramp = { kind = "ramp", slope = 1.0 }
chirp = { kind = "chirp", rate = 1.0, sweep = 1.0 }
expression = { kind = "expression", y = "t" }
table = { kind = "table", t = [0.0, 1.0], y = [0.0, 1.0] }
noise = { kind = "noise", deviation = 1.0, seed = 1 }
sum = { kind = "sum", signs = [1.0, -1.0] }
gain = { kind = "gain", K = 2.0 }
limit = { kind = "limit", lower = 0.0, upper = 1.0 }
lag = { kind = "lag", time_constant = 1.0 }
delay = { kind = "delay", delay = 0.1 }
sensor = { kind = "sensor", dropout = 0.1, seed = 1 }
product = { kind = "product", operations = "*/" }
switch = { kind = "switch" }
integrator = { kind = "integrator" }
transfer = { kind = "transfer-function", numerator = [1.0], denominator = [1.0, 1.0] }
pid = { kind = "pid", gain = 1.0 }
look = { kind = "look-up-table", u = [0.0, 1.0], y = [0.0, 1.0] }
controller = { kind = "controller", A = [[-1.0]], B = [[1.0]], C = [[1.0]] }
sampled = { kind = "discrete-state-space", period = 0.1, A = [[0.5]], B = [[1.0]], C = [[1.0]] }
[connections]
"sum.u1" = "step.y"
"sum.u2" = "ramp.y"
"gain.u" = "ramp.y"
"limit.u" = "ramp.y"
"lag.u" = "ramp.y"
"delay.u" = "ramp.y"
"sensor.u" = "ramp.y"
"product.u1" = "ramp.y"
"product.u2" = "constant.y"
"switch.u1" = "ramp.y"
"switch.u2" = "ramp.y"
"switch.control" = "step.y"
"integrator.u" = "ramp.y"
"transfer.u" = "ramp.y"
"pid.setpoint" = "ramp.y"
"pid.measurement" = "ramp.y"
"sampled.u" = "ramp.y"
"look.u" = "ramp.y"
"controller.u" = "ramp.y"
"""
DEPENDENT = {"fmu", "recording", "field-data", "python"}  # on a file
