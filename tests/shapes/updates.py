"""How parameters are updated and differentiated."""

import drjit as dr
import mitsuba as mi
import numpy as np
from mitsuba_subdivision import upload


def update(of, values=(), **named):
    """Assign parameters of an object, or of what `traverse` has shown of it, which is returned."""
    parameters = of if isinstance(of, mi.SceneParameters) else mi.traverse(of)
    for name, value in {**dict(values), **named}.items():
        parameters[name] = value
    parameters.update()
    return parameters


def differentiated(parameters, key):
    values = type(parameters[key])(dr.detach(parameters[key]))
    dr.enable_grad(values)
    update(parameters, {key: values})
    return values


MODES = ("backward", "forward", "difference")


def derivative(mode, assign, loss, step=1e-3):
    """Of a loss by the steps that are assigned: one of `MODES`, of which the last is central, over a step."""
    if mode == "difference":
        ends = []
        with dr.suspend_grad():
            for side in (step, -step):
                assign(mi.Float(side))
                ends.append(float(np.array(loss()).ravel()[0]))
        return (ends[0] - ends[1]) / (2 * step)
    # As a constant, Dr.Jit would widen it.
    by = dr.opaque(mi.Float, 0)
    dr.enable_grad(by)
    assign(by)
    value = loss()
    if mode == "forward":
        dr.forward(by)
    else:
        dr.backward(value)
    return float(np.array(dr.grad(value if mode == "forward" else by)).ravel()[0])


def moving(parameters, names, rng):
    """Function that moves parameters, all in one update, each along a random direction, by so many steps."""
    starts, alongs = {}, {}
    for name in [names] if isinstance(names, str) else names:
        is_matrix = name.endswith("to_world")
        starts[name] = start = dr.opaque(parameters[name].matrix if is_matrix else parameters[name])
        along = rng.normal(size=np.array(start).shape)
        if is_matrix:
            along[3] = 0
        alongs[name] = type(start)(along.tolist()) if is_matrix else upload(type(start), along)

    def assign(step):
        values = {name: start + alongs[name] * step for name, start in starts.items()}
        update(parameters, {k: mi.AffineTransform4f(v) if k.endswith("to_world") else v for k, v in values.items()})

    return assign
