"""The neural metric against the constant one, differences, its file, and its training."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from lagros_envs.tasks.cartpole import task
from lagros_envs.tasks.cartpole.physics import CartPole
from lagros_policies.contraction import (
    CvStemSettings,
    HeldControl,
    InfeasibleError,
    Metric,
    Samples,
    certified_tube,
    contraction_residual,
    extreme_eigenvalues,
    robust_control,
    verify_metric,
)
from lagros_policies.learning.networks import Mlp
from lagros_policies.tasks.cartpole.metric_design import MetricDesignSettings, tube_samples
from lagros_policies.tasks.cartpole.neural.design import hats, solve_at_angles, solve_on_pool
from lagros_policies.tasks.cartpole.neural.metric import (
    OUTPUTS,
    NeuralMetric,
    load_neural_metric,
    save_neural_metric,
)
from lagros_policies.tasks.cartpole.neural.training import NeuralTrainingSettings, fit_network
from lagros_policies.tasks.cartpole.region import Region

MODEL, REGION = CartPole(), Region()
SCALING = np.array([1.0, 12.0, 1.0, 1.5])


def random_metric(seed, last=0.3):
    rng = np.random.default_rng(seed)
    sizes = (1, 8, 8, OUTPUTS)
    weights = [rng.standard_normal(shape) for shape in itertools.pairwise(sizes)]
    weights[-1] *= last
    biases = [0.5 * rng.standard_normal(size) for size in sizes[1:]]
    return NeuralMetric(Mlp(weights, biases), 0.3, 50.0, 100.0, SCALING, REGION)


def triples(count, seed=0):
    rng = np.random.default_rng(seed)
    nominal = rng.uniform(-1.0, 1.0, (count, 4)) * [2.0, 0.6, 1.5, 1.0]
    error = rng.uniform(-1.0, 1.0, (count, 4)) * [0.5, 0.2, 0.5, 0.8]
    return Samples(nominal + error, nominal, rng.uniform(-5.0, 5.0, (count, 1)))


def test_with_constant_weights_it_is_the_constant_metric():
    rng = np.random.default_rng(4)
    factor = np.tril(0.2 * rng.standard_normal((4, 4)), -1) + np.diag(rng.uniform(0.5, 1.0, 4))
    bias = factor[np.tril_indices(4)].astype(np.float32)
    diagonal = np.equal(*np.tril_indices(4))
    exact = bias.astype(np.float64)
    bias[diagonal] = np.log(bias[diagonal])
    exact[diagonal] = np.exp(bias[diagonal].astype(np.float64))
    network = Mlp([np.ones((1, 3)), np.zeros((3, OUTPUTS))], [np.zeros(3), bias])
    neural = NeuralMetric(network, 0.3, 50.0, 100.0, SCALING, REGION)
    factor[np.tril_indices(4)] = exact
    matrix = SCALING[:, None] * (factor @ factor.T) * SCALING
    constant = Metric(np.linalg.inv(matrix)[None], 0.3, 50.0, 100.0, SCALING, REGION)
    some = triples(50)
    args = some.state, some.nominal, some.nominal_control
    assert neural.matrix(some.state) == pytest.approx(constant.matrix(some.state))
    assert np.all(neural.matrix_rate(some.state, some.state) == 0.0)
    for metric_law in (robust_control,):
        ours, theirs = (metric_law(MODEL, m, 0.3, *args) for m in (neural, constant))
        assert ours == pytest.approx(theirs)
    ours, theirs = (HeldControl(MODEL, m, 0.3, 0.1)(*args) for m in (neural, constant))
    assert ours == pytest.approx(theirs)
    ours, theirs = (contraction_residual(MODEL, m, some) for m in (neural, constant))
    assert ours == pytest.approx(theirs)
    assert certified_tube(neural, 0.5).radius(3.0) == pytest.approx(
        certified_tube(constant, 0.5).radius(3.0)
    )


@pytest.mark.parametrize("seed", range(3))
def test_its_rates_are_derivatives_and_it_is_positive_and_even(seed):
    metric = random_metric(seed)
    rng = np.random.default_rng(seed)
    state = rng.uniform(-1.1, 1.1, (40, 4)) * [1.0, 1.0, 1.0, 3.0]
    step, motion = 1e-6, rng.standard_normal((40, 4))
    moved = state[:, None] + step * motion[:, None] * np.array([[1.0], [-1.0]])
    for value, rate in ((metric.matrix, metric.matrix_rate), (metric.dual, metric.dual_rate)):
        both = value(moved)
        slope = (both[:, 0] - both[:, 1]) / (2.0 * step)
        assert rate(state, motion) == pytest.approx(slope, rel=1e-4, abs=1e-5 * np.abs(slope).max())
    assert np.linalg.eigvalsh(metric.matrix(state)).min() > 0.0
    assert metric.matrix(-state) == pytest.approx(metric.matrix(state))
    # dM/dt is even too, as theta and dtheta/dt change sign together.
    assert metric.matrix_rate(-state, -motion) == pytest.approx(metric.matrix_rate(state, motion))
    assert metric.matrix(state[3]) == pytest.approx(metric.matrix(state)[3])


def test_shares_of_the_angles_interpolate():
    nodes = np.linspace(0.0, 1.15, 6)
    shares, _ = hats(nodes, nodes)
    assert shares == pytest.approx(np.eye(6), abs=1e-12)
    angle = np.random.default_rng(0).uniform(-1.14, 1.14, 200)
    shares, slopes = hats(angle, nodes)
    assert shares.sum(axis=1) == pytest.approx(np.ones(200))
    assert shares.min() >= 0.0
    # cos(theta) itself is reproduced, and so is its derivative.
    assert shares @ np.cos(nodes) == pytest.approx(np.cos(angle))
    assert slopes @ np.cos(nodes) == pytest.approx(-np.sin(angle))
    ahead, behind = hats(angle + 1e-7, nodes)[0], hats(angle - 1e-7, nodes)[0]
    away = np.abs(np.abs(angle)[:, None] - nodes).min(axis=1) > 1e-5
    assert slopes[away] == pytest.approx((ahead - behind)[away] / 2e-7, abs=1e-5)


def test_program_meets_its_condition():
    settings = CvStemSettings(contraction_rate=0.3)
    region = Region(angle=0.8, angular_rate=2.0, angle_error=0.2, angular_rate_error=0.8, force=5)
    active = triples(25, 1)
    solution = solve_at_angles(MODEL, active, region, settings, 4)
    # The margin of the program is left over at the triples that it saw.
    assert contraction_residual(MODEL, solution, active).max() < -1.5 * settings.margin
    scaled = solution.duals * SCALING[:, None] * SCALING
    values = np.linalg.eigvalsh(scaled)
    assert values.min() > 1.0 - 1e-6
    assert values.max() < solution.condition_bound * (1.0 + 1e-6)


def test_rounds_look_for_what_is_violated():
    settings = CvStemSettings(contraction_rate=0.3)
    region = Region(angle=0.8, angular_rate=2.0, angle_error=0.2, angular_rate_error=0.8, force=5)
    pool = triples(300, 3)
    worst = [
        contraction_residual(
            MODEL, solve_on_pool(MODEL, pool, region, settings, 3, 10, rounds), pool
        ).max()
        for rounds in (1, 3)
    ]
    assert worst[1] < worst[0]


def test_too_fast_a_rate_is_refused():
    with pytest.raises(InfeasibleError, match="alpha=30"):
        solve_at_angles(MODEL, triples(20), REGION, CvStemSettings(contraction_rate=30.0), 2)


@pytest.mark.slow
def test_the_network_learns_the_solution_and_then_the_condition():
    region = Region(angle=0.8, angular_rate=2.0, angle_error=0.2, angular_rate_error=0.8, force=5)
    pool = triples(60, 1)
    settings = CvStemSettings(contraction_rate=0.3)
    solution = solve_at_angles(MODEL, triples(25, 1), region, settings, 4)
    short = NeuralTrainingSettings(hidden=(16, 16), fit_steps=1500, condition_steps=0, batch=32)
    fitted = fit_network(MODEL, pool, solution, region, short)
    states = np.zeros((50, 4))
    states[:, 1] = np.linspace(0.0, region.angle, 50)
    # W_bar of both, up to a factor: it changes no control.
    scale = SCALING[:, None] * SCALING
    learned, wanted = fitted.dual(states) * scale, solution.dual(states) * scale
    learned *= np.trace(wanted, axis1=1, axis2=2).sum() / np.trace(learned, axis1=1, axis2=2).sum()
    distance = np.linalg.norm(learned - wanted, axis=(1, 2))
    assert np.all(distance < 0.2 * np.linalg.norm(wanted, axis=(1, 2)))
    least, largest = extreme_eigenvalues(fitted)
    assert 0.0 < least < largest
    trained = fit_network(MODEL, pool, solution, region, replace(short, condition_steps=150))
    before, after = (
        contraction_residual(MODEL, metric, pool).max() for metric in (fitted, trained)
    )
    assert after < before
    again = fit_network(MODEL, pool, solution, region, short)
    np.testing.assert_array_equal(again.matrix(states), fitted.matrix(states))


def test_file_keeps_everything(tmp_path):
    path = tmp_path / "metric.safetensors"
    checked = verify_metric(MODEL, random_metric(1), triples(30), 5)
    save_neural_metric(checked, path)
    loaded = load_neural_metric(path)
    state = triples(5).state
    assert np.array_equal(loaded.matrix(state), checked.matrix(state))
    assert loaded.verification == checked.verification
    assert loaded.region == checked.region
    assert loaded.control_weight == checked.control_weight
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(ValueError, match="damaged"):
        load_neural_metric(path)
    random_metric(1).network.save(path)
    with pytest.raises(ValueError, match=r"not that of a metric"):
        load_neural_metric(path)
    with pytest.raises(FileNotFoundError):
        load_neural_metric(tmp_path / "none.safetensors")


def test_shipped_metric_holds_on_states_of_its_own():
    metric = load_neural_metric()
    assert metric.verification.samples >= 10_000
    settings = MetricDesignSettings(plans=30, seed=5)
    fresh = tube_samples(settings, task.CartPoleSettings(), 31, 3000)
    residual = contraction_residual(MODEL, metric, fresh)
    assert np.mean(residual <= 0.0) >= 0.995
    least, largest = extreme_eigenvalues(metric)
    assert 0.0 < least < largest
    a, b, c = HeldControl(MODEL, metric, metric.contraction_rate, 0.1).quadratic(
        fresh.state, fresh.nominal, fresh.nominal_control
    )
    assert np.mean(b * b >= a * c) >= 0.999


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: replace(random_metric(0), contraction_rate=0.0), "contraction_rate=0"),
        (lambda: replace(random_metric(0), scaling=np.ones(3)), "scaling"),
        (
            lambda: replace(random_metric(0), network=Mlp([np.ones((2, 10))], [np.zeros(10)])),
            "inputs",
        ),
        (lambda: NeuralTrainingSettings(hidden=()), "hidden"),
        (lambda: NeuralTrainingSettings(learning_rate=0.0), "learning_rate"),
        (lambda: NeuralTrainingSettings(condition_steps=-1), "condition_steps"),
    ],
)
def test_wrong_values_are_named(build, message):
    with pytest.raises(ValueError, match=message):
        build()
