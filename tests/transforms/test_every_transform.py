"""Every transform through every stepper, solver and scheme: the cells of `docs/transforms.md`, measured by `benchmarks.transforms`."""

import pytest

from benchmarks import transforms

# These cross every rule that the others do, and compiling all cells takes minutes: the command measures the rest.
FEW = ("vmap(grad)", "jacfwd", "hessian")


pytestmark = pytest.mark.usefixtures("sooner")


def cells(function, names):
    """What is said of these transforms of a function."""
    differences = transforms.Differences(function)
    return {name: transforms.cell(function, differences, name) for name in names}


@pytest.mark.slow
@pytest.mark.parametrize("name", transforms.STEPPERS)
def test_transforms_go_through_every_stepper(name):
    """Batched gradients, forward mode and second derivatives agree with differences."""
    assert cells(transforms.STEPPERS[name], FEW) == dict.fromkeys(FEW, "right")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Skyline", "equilibrium", "BackwardEulerHeat"])
def test_forward_mode_goes_through_every_kind_of_solver(name):
    """The Jacobian, with batched tangents, agrees with differences."""
    assert cells(transforms.OTHERS[name], ["jacfwd"]) == {"jacfwd": "right"}


@pytest.mark.slow
@pytest.mark.parametrize("name", transforms.SCENES)
def test_transforms_go_through_every_scene(name):
    """Batched gradients agree with differences."""
    assert cells(transforms.SCENES[name], ["vmap(grad)"]) == {"vmap(grad)": "right"}
