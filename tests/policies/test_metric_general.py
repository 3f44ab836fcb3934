"""Metrics of x and of x_d over any basis, for several controls: design, rates, laws, files."""

import json
from dataclasses import fields, replace

import cvxpy as cp
import numpy as np
import pytest

from lagros_envs.dynamics import hold_step
from lagros_policies.contraction import (
    Basis,
    BoxRegion,
    CvStemSettings,
    HeldControl,
    Metric,
    PlanRegion,
    Samples,
    certified_tube,
    contraction_residual,
    cosines,
    design_metric,
    design_on_region,
    extreme_eigenvalues,
    harmonics,
    load_metric,
    powers,
    products,
    robust_control,
    save_metric,
    search_violation,
    theorems,
    verify_metric,
)
from lagros_policies.contraction.cvstem import least_condition
from lagros_policies.proof import bounds
from lagros_policies.proof.condition import prove_contraction
from lagros_policies.remarks.stochastic import mean_square_bound
from lagros_policies.tasks.cartpole.proof import prove_cartpole
from lagros_policies.tasks.cartpole.region import Region
from tests.policies.foreign import (
    Car,
    Pvtol,
    Triple,
    brute_residual,
    moved,
    positive,
    reach,
    slopes,
)
from tests.policies.shipped import shipped_metric

CAR_BOX = BoxRegion(
    (-2.0, -2.0, -1.0, 1.0), (2.0, 2.0, 1.0, 2.0), (0.3,) * 4, (-1.0, -1.0), (1.0, 1.0)
)
PVTOL_BOX = BoxRegion(
    (-1.0, -1.0, -0.6, -1.0, -0.5, -0.5),
    (1.0, 1.0, 0.6, 1.0, 0.5, 0.5),
    (0.3,) * 6,
    (2.0, 2.0),
    (3.0, 3.0),
)
TWO = products(powers(0, 1), powers(1, 1))
TRIPLE_BOX = BoxRegion((-1.0,) * 4, (1.0,) * 4, (0.4,) * 4, (-1.0,) * 3, (1.0,) * 3)


def built(system, box, basis, point, share=0.1):
    """Return a metric of a basis whose coefficients mean nothing but are positive together."""
    n = system.state_dim
    rng = np.random.default_rng(3)
    parts = rng.standard_normal((basis.size, n, n)) * share
    parts = parts + np.swapaxes(parts, 1, 2)
    parts[0] = positive(n)
    return Metric(parts, 0.3, 90.0, 3.0, np.ones(n), box, None, basis, point)


def car_metric(point="nominal"):
    return built(Car(), CAR_BOX, products(harmonics(2, 1), powers(3, 1)), point)


def pvtol_metric(point="state"):
    return built(Pvtol(), PVTOL_BOX, products(cosines(2, 2), powers(3, 1)), point)


def triple_metric(point):
    return built(Triple(), TRIPLE_BOX, harmonics(3, 2), point)


CASES = [
    pytest.param(Car(), car_metric(), id="car, of x_d"),
    pytest.param(Pvtol(), pvtol_metric(), id="pvtol, of x"),
    pytest.param(Pvtol(), pvtol_metric("nominal"), id="pvtol, of x_d"),
    pytest.param(Triple(), triple_metric("state"), id="triple, of x"),
    pytest.param(Triple(), triple_metric("nominal"), id="triple, of x_d"),
]


def draw(metric, count, seed=0):
    return metric.region.sample(np.random.default_rng(seed), count)


def whole(place, samples):
    return samples.nominal if place == "nominal" else samples.state


# The condition.


@pytest.mark.parametrize(("system", "metric"), CASES)
def test_the_condition_is_that_of_brute_force(system, metric):
    samples = draw(metric, 60)
    expected = brute_residual(system, metric, samples)
    found = contraction_residual(system, metric, samples)
    assert found == pytest.approx(expected, rel=1e-5, abs=1e-6)
    checked = verify_metric(system, metric, samples, 0).verification
    assert checked.worst == pytest.approx(expected.max(), rel=1e-5)
    assert checked.violations >= np.sum(expected > 1e-5)
    # u_d - nu B'Me, the gain of the proof, contracts where the condition holds, and only there.
    feasible = theorems.feasibility_residual(system, metric, samples)
    assert np.all(feasible[expected <= 0.0] <= 1e-9)


@pytest.mark.parametrize("system", [Car(), Pvtol()])
def test_a_metric_of_the_state_that_a_control_moves_is_refused(system):
    if isinstance(system, Car):
        metric, control = car_metric("state"), 0
    else:
        metric, control = built(system, PVTOL_BOX, powers(4, 1), "state"), 0
    samples = draw(metric, 20)
    args = samples.state, samples.nominal, samples.nominal_control
    settings = CvStemSettings(
        0.3, 0, scaling=(1.0,) * system.state_dim, basis=metric.basis, point="state"
    )
    for ask in (
        lambda: contraction_residual(system, metric, samples),
        lambda: verify_metric(system, metric, samples, 0),
        lambda: robust_control(system, metric, 0.3, *args),
        lambda: design_metric(system, samples, metric.region, settings),
    ):
        with pytest.raises(ValueError, match=rf"control {control} of .*moves.*point=\"nominal\""):
            ask()
    # Of x_d it is right: the control of a plan is known.
    nominal = replace(metric, point="nominal")
    expected = brute_residual(system, nominal, samples)
    assert contraction_residual(system, nominal, samples) == pytest.approx(expected, rel=1e-5)


def test_a_metric_that_is_broken_by_its_true_rate_is_refused():
    """Read as a metric of state 1 at the rate of state 3 its W_bar would not move at all."""
    parts = np.stack([positive(6), positive(6, 1)])
    metric = Metric(parts, 0.2, 50.0, 3.0, np.ones(6), PVTOL_BOX, None, cosines(2, 1))
    samples = draw(metric, 200)
    expected = brute_residual(Pvtol(), metric, samples)
    assert expected.max() > 0.7
    checked = verify_metric(Pvtol(), metric, samples, 0).verification
    assert checked.violations >= np.sum(expected > 0.7) > 0
    found, worst = search_violation(Pvtol(), metric, 0)
    assert worst >= expected.max()
    assert brute_residual(Pvtol(), metric, found)[0] == pytest.approx(worst, rel=1e-5)
    # The proof, too, says no, and where.
    refused = prove_contraction(Pvtol(), metric, PVTOL_BOX)
    point = refused.violation
    assert refused.refuted
    assert not refused.proved
    triple = Samples(*(part[None] for part in (point.state, point.nominal, point.control)))
    same = Samples(triple.nominal, triple.nominal, triple.nominal_control)
    assert max(brute_residual(Pvtol(), metric, one)[0] for one in (triple, same)) > 0.0


# The design.


def stated_in_cvxpy(system, samples, places, settings):
    """Return (chi, nu) of Theorem 2's program, by brute force but for the functions themselves."""
    n, phi = system.state_dim, settings.phi
    duals = [cp.Variable((n, n), symmetric=True) for _ in range(phi.size)]
    chi, nu = cp.Variable(), cp.Variable(nonneg=True)
    rate = settings.contraction_rate + settings.margin
    way = np.linspace(0.0, 1.0, 201)[:, None]
    weight = np.ones(201)
    weight[1:-1:2], weight[2:-1:2] = 4.0, 2.0
    conditions, h = [], 1e-5
    for x, x_d, u_d in zip(samples.state, samples.nominal, samples.nominal_control, strict=True):
        slope = slopes(system, way * x + (1.0 - way) * x_d, u_d[None])
        slope = np.einsum("q,qij->ij", weight / weight.sum(), slope)
        place = x_d if settings.point == "nominal" else x
        flow = moved(system, place, u_d)
        here = phi.at(place)
        change = (phi.at(place + h * flow) - phi.at(place - h * flow)) / (2.0 * h)
        dual = sum(float(a) * W for a, W in zip(here, duals, strict=True))
        moving = sum(float(a) * W for a, W in zip(change, duals, strict=True))
        gain = reach(system, x)
        left = slope @ dual + dual @ slope.T - moving - 2 * nu * gain @ gain.T + 2 * rate * dual
        conditions.append((left + left.T) / 2 << 0)
    scale = np.diag(settings.scaling)
    for value in phi.at(places):
        scaled = scale @ sum(float(a) * W for a, W in zip(value, duals, strict=True)) @ scale
        conditions += [scaled >> np.eye(n), scaled << chi * np.eye(n)]
    problem = cp.Problem(cp.Minimize(chi + settings.control_penalty * nu), conditions)
    problem.solve(solver=cp.CLARABEL)
    assert problem.status == "optimal"
    return float(chi.value), float(nu.value)


@pytest.mark.parametrize(
    ("system", "box", "basis", "point", "rate", "scaling"),
    [
        pytest.param(
            *(Car(), CAR_BOX, harmonics(2, 1), "nominal", 0.3, (1.0, 1.0, 2.0, 1.0)), id="car"
        ),
        pytest.param(
            *(Pvtol(), PVTOL_BOX, cosines(2, 1), "state", 0.3, (1.0, 1.0, 2.0, 1.0, 1.0, 1.0)),
            id="pvtol",
        ),
        pytest.param(
            *(Triple(), TRIPLE_BOX, powers(3, 1), "state", 3.0, (1.0, 1.0, 1.0, 1.5)), id="triple"
        ),
        pytest.param(
            *(Triple(), TRIPLE_BOX, harmonics(3, 1), "nominal", 3.0, (1.0,) * 4), id="of x_d"
        ),
        pytest.param(*(Triple(), TRIPLE_BOX, TWO, "nominal", 3.0, (1.0,) * 4), id="of two"),
        pytest.param(
            *(Triple(), TRIPLE_BOX, powers(0, 0), "state", 3.0, (1.0,) * 4), id="constant"
        ),
    ],
)
def test_a_design_is_the_optimum_of_the_program_stated_in_cvxpy(
    system, box, basis, point, rate, scaling
):
    settings = CvStemSettings(rate, 0, 0.1, 0.05, scaling, basis, point)
    samples = box.sample(np.random.default_rng(5), 12)
    metric = design_metric(system, samples, box, settings)
    # The bounds on a grid of the coordinates that the functions depend on.
    ends = [np.linspace(box.low[one], box.high[one], 7) for one in basis.coordinates]
    grid = np.stack(np.meshgrid(*ends), axis=-1).reshape(-1, len(ends)) if ends else [[]]
    places = np.zeros((len(grid), system.state_dim))
    places[:, basis.coordinates] = grid
    chi, nu = stated_in_cvxpy(system, samples, places, settings)
    cost = metric.condition_bound + 0.1 * metric.control_weight
    assert cost == pytest.approx(chi + 0.1 * nu, rel=2e-2 if basis.degree else 1e-3)
    residual = contraction_residual(system, metric, samples)
    assert residual.max() == pytest.approx(-2.0 * settings.margin, abs=1e-3)
    scaled = metric.dual(places) * np.outer(scaling, scaling)
    values = np.linalg.eigvalsh(scaled)
    assert values.min() >= 1.0 - 1e-6
    assert values.max() <= metric.condition_bound * (1.0 + 1e-6)
    assert (metric.basis, metric.point, metric.region) == (basis, point, box)
    # Solved once, with the bounds at a few places: as good, or less.
    least = least_condition(system, samples, box, settings)
    assert least <= metric.condition_bound * 1.02
    assert basis.degree or least == pytest.approx(metric.condition_bound, rel=1e-4)


def test_a_design_on_a_region_holds_all_over_it():
    settings = CvStemSettings(1.8, 0, 0.05, 0.1, (1.0,) * 4, harmonics(3, 1), "nominal")

    def design(**effort):
        return design_on_region(Triple(), TRIPLE_BOX, settings, pool=40, first=20, **effort)

    metric = design()
    fresh = TRIPLE_BOX.sample(np.random.default_rng(99), 3000)
    assert brute_residual(Triple(), metric, fresh.take(np.arange(100))).max() < 0.0
    checked = verify_metric(Triple(), metric, fresh, 99).verification
    assert checked.violations == 0
    assert checked.worst < 0.0
    assert search_violation(Triple(), metric, 0)[1] < 0.0
    with pytest.raises(RuntimeError, match="after 1 programs"):
        design(rounds=1)


# The control laws.


@pytest.mark.parametrize(("system", "metric"), CASES)
def test_the_control_at_will_contracts_along_the_integrated_motion(system, metric):
    samples = draw(metric, 40, 7)
    x, x_d, u_d = samples.state, samples.nominal, samples.nominal_control
    u = robust_control(system, metric, 0.3, x, x_d, u_d)

    def energy(h):
        ahead = hold_step(system, x, u, h), hold_step(system, x_d, u_d, h)
        error = ahead[0] - ahead[1]
        place = ahead[1] if metric.point == "nominal" else ahead[0]
        return np.einsum("si,sij,sj->s", error, np.linalg.inv(metric.dual(place)), error)

    h = 1e-5
    change = (energy(h) - energy(-h)) / (2.0 * h)
    assert np.all(change <= -2.0 * 0.3 * energy(0.0) * (1.0 - 1e-5) + 1e-7)
    # Nothing is done where u_d contracts, and where it does not the bound is met, no more.
    acts = np.abs(u - u_d).max(axis=1) > 0.0
    assert acts.sum() > 0
    assert change[acts] == pytest.approx(-0.6 * energy(0.0)[acts], rel=1e-4, abs=1e-6)


@pytest.mark.parametrize(("system", "metric"), CASES)
def test_the_held_control_meets_its_condition_at_the_next_instant(system, metric):
    samples = draw(metric, 40, 8)
    x, x_d, u_d = samples.state, samples.nominal, samples.nominal_control
    law, h = HeldControl(system, metric, 0.3, 0.05), 1e-5
    v = law(x, x_d, u_d) - u_d
    ahead, planned = hold_step(system, x, u_d, 0.05), hold_step(system, x_d, u_d, 0.05)
    units = np.eye(system.control_dim) * h
    columns = [
        (hold_step(system, x, u_d + unit, 0.05) - hold_step(system, x, u_d - unit, 0.05)) / (2 * h)
        for unit in units
    ]
    nominal = metric.point == "nominal"
    after = np.linalg.inv(metric.dual(planned if nominal else ahead))
    before = np.linalg.inv(metric.dual(x_d if nominal else x))
    error = ahead - planned + np.einsum("jsi,sj->si", np.array(columns), v)
    left = np.einsum("si,sij,sj->s", error, after, error)
    allowed = np.exp(-2.0 * 0.3 * 0.05) * np.einsum("si,sij,sj->s", x - x_d, before, x - x_d)
    a, b, c = law.quadratic(x, x_d, u_d)
    possible = c - np.einsum("si,si->s", b, np.linalg.solve(a, b[..., None])[..., 0]) < 0.0
    assert possible.sum() > 5
    assert np.all(left[possible] <= allowed[possible] * (1.0 + 1e-6))
    acts = possible & (np.abs(v).max(axis=1) > 0.0)
    assert left[acts] == pytest.approx(allowed[acts], rel=1e-6)


# Bounds over the region, and what follows from them.


@pytest.mark.parametrize(("system", "metric"), CASES)
def test_extreme_eigenvalues_are_those_of_the_whole_region(system, metric):
    values = np.linalg.eigvalsh(metric.matrix(whole(metric.point, draw(metric, 50_000, 11))))
    least, largest = extreme_eigenvalues(metric)
    assert least <= values.min()
    assert largest >= values.max()
    assert least == pytest.approx(values.min(), rel=0.05)
    assert largest == pytest.approx(values.max(), rel=0.05)
    tube = certified_tube(metric, 0.2)
    assert tube.steady_radius == pytest.approx(0.2 / 0.3 * np.sqrt(largest / least))


def test_noise_moves_no_metric_of_the_plan_and_others_are_refused():
    metric, intensity = car_metric(), np.array([0.1, 0.2, 0.3, 0.1])
    bound = mean_square_bound(metric, intensity)
    matrices = metric.matrix(draw(metric, 2000, 12).nominal)
    power = np.einsum("sii,i->s", matrices, intensity**2).max()
    assert bound.rate == 0.3
    assert bound.power == pytest.approx(power, rel=0.05)
    with pytest.raises(ValueError, match="BoxRegion, is even in no coordinate"):
        mean_square_bound(triple_metric("state"), intensity)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"basis": harmonics(2, 1)}, "are 6, and the basis has 3 functions"),
        ({"basis": products(harmonics(2, 1), powers(4, 1))}, r"x\[4\] is none of the 4 states"),
        ({"point": "plan"}, "point"),
        ({"region": PVTOL_BOX}, "of 6 states, and the metric is of 4"),
        # 1 - x[3] / 2 is below zero from 2 on, which the region hardly reaches.
        (
            {
                "basis": powers(3, 1),
                "coefficients": np.stack([np.eye(4), -0.5 * np.eye(4)]),
                "region": replace(CAR_BOX, high=(2.0, 2.0, 1.0, 2.1)),
            },
            r"not positive .* x\[3\]=2\.",
        ),
        ({"scaling": np.ones(3)}, "scaling"),
    ],
)
def test_what_is_no_metric_is_refused_by_name(change, why):
    with pytest.raises(ValueError, match=why) as caught:
        replace(car_metric(), **change)
    assert "\n" not in str(caught.value)


def test_what_is_of_one_coordinate_or_of_the_cartpole_refuses_another_metric():
    two = built(Pvtol(), PVTOL_BOX, products(cosines(2, 1), cosines(1, 1)), "state")
    with pytest.raises(ValueError, match=r"coordinates \(1, 2\): metric_drift is for one"):
        bounds.metric_drift(two, 0.0, 0.5)
    boxed = Metric(positive(4)[None], 0.2, 9.0, 1.0, np.ones(4), CAR_BOX)
    for metric, why in (
        (replace(shipped_metric(), point="nominal"), "at the nominal, on a Region"),
        (boxed, "on a BoxRegion"),
    ):
        with pytest.raises(ValueError, match=why):
            prove_cartpole(metric)


# Files.


def cloud_metric():
    rng = np.random.default_rng(0)
    cloud = PlanRegion(
        rng.uniform(-1, 1, (7, 4)), rng.uniform(-1, 1, (7, 2)), [0.1] * 4, [0.2] * 2, [0.3] * 4
    )
    return replace(car_metric(), region=cloud)


@pytest.mark.parametrize(
    "metric",
    [
        pytest.param(car_metric(), id="box"),
        pytest.param(cloud_metric(), id="plans"),
        pytest.param(pvtol_metric(), id="state"),
        pytest.param(replace(shipped_metric(), point="nominal"), id="nominal, on a Region"),
        pytest.param(replace(shipped_metric(), basis=cosines(1, 4)), id="named"),
    ],
)
def test_a_file_keeps_every_bit_of_a_general_metric(metric, tmp_path):
    path, again = tmp_path / "metric.json", tmp_path / "again.json"
    save_metric(metric, path)
    loaded = load_metric(path)
    save_metric(loaded, again)
    assert path.read_bytes() == again.read_bytes()
    assert (loaded.phi, loaded.point) == (metric.phi, metric.point)
    assert type(loaded.region) is type(metric.region)
    for item in fields(metric.region):
        ours, theirs = (getattr(one.region, item.name) for one in (metric, loaded))
        assert np.array_equal(ours, theirs)
    place = whole(metric.point, draw(metric, 9))
    assert np.array_equal(loaded.dual(place), metric.dual(place))


def test_a_metric_of_the_angle_is_written_as_ever(tmp_path):
    metric = shipped_metric()
    save_metric(replace(metric, basis=cosines(1, 4)), tmp_path / "named.json")
    save_metric(metric, tmp_path / "plain.json")
    assert (tmp_path / "named.json").read_bytes() == (tmp_path / "plain.json").read_bytes()
    assert json.loads((tmp_path / "plain.json").read_text())["format"] == "lagros-metric-1"


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"basis": ["1", "exec(x[0])"]}, "terms: .*exec"),
        ({"basis": "cos(theta)^i"}, "basis"),
        ({"basis": [1, 2]}, "basis"),
        ({"basis": ["1"]}, "the basis has 1 functions"),
        ({"point": "elsewhere"}, "point"),
        ({"point": 3}, "point"),
        ({"region": {"kind": "ball"}}, "kind"),
        ({"region": {"kind": "box", "low": [0.0]}}, "high"),
        ({"region": Region().__dict__ | {"kind": "box"}}, "low"),
        ({"format": "lagros-metric-1"}, "basis"),
        ({"format": "lagros-metric-3"}, "format"),
    ],
)
def test_a_general_file_that_is_damaged_is_refused_by_name(change, why, tmp_path):
    path = tmp_path / "metric.json"
    save_metric(car_metric(), path)
    record = json.loads(path.read_text())
    for key in ("low", "error", "control_low"):
        region = {**record["region"], key: [[1.0]]}
        path.write_text(json.dumps({**record, "region": region}))
        with pytest.raises(ValueError, match=rf"metric\.json.*{key}"):
            load_metric(path)
    path.write_text(json.dumps({**record, **change}))
    with pytest.raises(ValueError, match=rf"metric\.json.*{why}") as caught:
        load_metric(path)
    assert "\n" not in str(caught.value)


def test_a_region_of_one_s_own_flies_and_is_not_written(tmp_path):
    class Own:
        def sample(self, rng, count):
            return CAR_BOX.sample(rng, count)

        def contains(self, state, nominal, nominal_control):
            return CAR_BOX.contains(state, nominal, nominal_control)

    metric = replace(car_metric(), region=Own())
    assert extreme_eigenvalues(metric) == extreme_eigenvalues(car_metric())
    with pytest.raises(TypeError, match="must be a BoxRegion, a PlanRegion or that of a task"):
        save_metric(metric, tmp_path / "metric.json")
    assert not (tmp_path / "metric.json").exists()


@pytest.mark.parametrize("number", ["pool", "first", "rounds"])
def test_numbers_of_a_design_are_positive(number):
    settings = CvStemSettings(0.3, 0, scaling=(1.0,) * 4)
    with pytest.raises(ValueError, match=f"{number}=0 must be a whole number >= 1"):
        design_on_region(Triple(), TRIPLE_BOX, settings, **{number: 0})


def test_a_design_without_a_basis_is_of_the_even_coordinate_of_a_region():
    settings = CvStemSettings(0.3, 2, scaling=(1.0,) * 6)
    samples = PVTOL_BOX.sample(np.random.default_rng(0), 5)
    with pytest.raises(ValueError, match=r"degree=2 .*name a basis, or take degree=0"):
        design_metric(Pvtol(), samples, PVTOL_BOX, settings)
    beyond = replace(settings, basis=Basis(("1", "x[6]")))
    with pytest.raises(ValueError, match=r"x\[6\] is none of the 6 states"):
        design_metric(Pvtol(), samples, PVTOL_BOX, beyond)
