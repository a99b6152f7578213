"""The hierarchy's answers: exact, certified, strict, whatever the solver and the problem."""

import dataclasses
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import proxsuite
import pytest
from oracle import lexicographic_optimum
from problems import (
    CONTACTS,
    Rows,
    anything,
    box,
    equal,
    forces,
    general,
    joints,
    near_singular,
    scaling,
    three_level,
)
from test_oracle import HAND

import hqp_grasp
from hqp_grasp import HQP, InputError, Level, Projection, Solution, SolverError
from hqp_grasp.hierarchy import active_set, qp_solvers
from hqp_grasp.hierarchy import hqp as hqp_module
from hqp_grasp.hierarchy.hqp import ROUNDS, solvers

INF = np.inf
# What strictness is promised to: lower levels worsen none above by more than this, relative. As
# the active set is settled exactly, everything else here holds to the same; a miss is measured in
# units of its rows, |nearest admissible value| + ‖a‖‖x‖.
TOL = 1e-9

ANY = "proxqp"  # where the solver makes no difference
THREE = ("proxqp", "active-set", "daqp")
ANGLES = [10.0**-k for k in range(1, 15)]


@pytest.fixture(params=solvers())
def solver(request):
    return request.param


def built(problem):
    return [Level(*rows) for rows in problem]


def solve(problem, solver=ANY, **options):
    """The certified answer to a hierarchy."""
    levels = built(problem)
    answer = HQP(solver=solver, **options).solve(levels)
    assert np.isfinite(answer.x).all()
    assert answer.certified and answer.is_optimal(levels)
    for level, report in zip(levels, answer.levels, strict=True):
        room = TOL * units(level, answer.x)
        np.testing.assert_allclose(report.residual, level.residual(answer.x), rtol=0, atol=room)
    return answer


def units(rows, x, floor=0.0):
    nearest = np.clip(rows.A @ x, rows.lower, rows.upper)
    length = np.linalg.norm(x) + floor
    return np.linalg.norm(np.abs(nearest) + np.linalg.norm(rows.A, axis=1) * length)


def rounding(problem):
    """A length of x that is none: 1e-15 of the way to the farthest bound that x = 0 breaks."""
    far = 0.0
    for A, lower, upper in problem:
        norm = np.linalg.norm(A, axis=1)
        bound = np.abs(np.clip(0.0, lower, upper))[norm > 0]
        far = max(far, np.max(bound / norm[norm > 0], initial=0.0))
    return 1e-15 * far


def assert_same_misses(problem, x, misses):
    """Every level is missed by as much as the optimum misses it, neither more nor less."""
    floor = rounding(problem) / TOL
    for k, (rows, known) in enumerate(zip(problem, misses, strict=False)):
        ours = np.linalg.norm(Level(*rows).residual(x))
        room = TOL * units(rows, x, floor)
        assert abs(ours - np.linalg.norm(known)) <= room, f"level {k}"


def assert_same_point(x, known):
    np.testing.assert_allclose(x, known, rtol=0, atol=TOL * (1.0 + np.linalg.norm(known)))


def fuzz(seed, **options):
    return general(np.random.default_rng(np.random.SeedSequence([7, seed])), **options)


# ---------------------------------------------------------------- exact


@pytest.mark.parametrize("name", HAND)
def test_answers_known_by_hand(name):
    problem, x, misses = HAND[name]
    for solver in solvers():
        answer = solve(problem, solver)
        assert_same_point(answer.x, x)
        assert_same_misses(problem, answer.x, misses)


@pytest.mark.parametrize("difficulty", ["easy", "mid", "hard"])
def test_every_solver_gives_the_reference_optimum(difficulty, solver):
    for seed in range(3):
        problem = three_level(np.random.default_rng(seed), difficulty)
        x, misses = lexicographic_optimum(problem)
        answer = solve(problem, solver)
        assert_same_point(answer.x, x)
        assert_same_misses(problem, answer.x, misses)


@pytest.mark.parametrize(("n", "levels"), [(6, 2), (6, 8), (12, 5), (20, 3), (30, 6)])
def test_sizes_of_real_robots_are_answered_exactly(n, levels):
    problem = scaling(np.random.default_rng(n), n, levels)
    x, misses = lexicographic_optimum(problem)
    answer = solve(problem)
    assert_same_point(answer.x, x)
    assert_same_misses(problem, answer.x, misses)


@pytest.mark.parametrize("seed", range(150))
def test_anything_that_can_be_built_is_missed_by_as_little_as_possible(seed):
    problem = fuzz(seed, max_n=12, max_levels=5, max_rows=6)
    answer = solve(problem, THREE[seed % 3])
    known, misses = lexicographic_optimum(problem)
    assert_same_misses(problem, answer.x, misses)
    # and of the optima, none is shorter
    assert np.linalg.norm(answer.x) <= (1.0 + TOL) * np.linalg.norm(known) + rounding(problem)


@pytest.mark.parametrize("seed", range(100))
def test_anything_large_is_certified(seed):
    solve(fuzz(1000 + seed), THREE[seed % 3])


@pytest.mark.parametrize("seed", range(10))
def test_anything_small_is_answered_by_every_solver_alike(seed):
    problem = fuzz(2000 + seed, max_n=8, max_levels=4, max_rows=5, scales=False)
    x, misses = lexicographic_optimum(problem)
    for solver in solvers():
        answer = solve(problem, solver)
        assert_same_point(answer.x, x)
        assert_same_misses(problem, answer.x, misses)


@pytest.mark.parametrize("unit", [1e-3, 1e-9, 1e-15])
def test_a_level_in_small_units_below_one_in_large_units_is_solved_in_its_own(unit):
    problem = [equal([[1, 1, 0], [1, 1, 0]], [1, 2]), equal([[unit, 0, unit]], [unit])]
    assert_same_point(solve(problem).x, lexicographic_optimum(problem)[0])


@pytest.mark.parametrize("unit", [1e-3, 1e-6])
def test_a_limit_in_small_units_beside_one_in_large_units_is_kept(unit):
    limits = Rows(np.diag([1.0, unit]), np.full(2, -INF), np.array([1.0, unit]))
    for solver in solvers():
        answer = solve([limits, equal(np.eye(2), [5.0, 5.0])], solver)
        assert_same_point(answer.x, [1, 1])


# ---------------------------------------------------------------- strict


@pytest.mark.parametrize("seed", range(40))
def test_lower_levels_never_worsen_those_above(seed):
    if seed % 2:
        problem = three_level(np.random.default_rng(seed), ("easy", "mid", "hard")[seed % 3])
    else:
        problem = fuzz(3000 + seed)
    whole = solve(problem)
    for k in range(1, len(problem)):
        prefix = solve(problem[:k])
        assert_same_misses(problem[:k], whole.x, [level.residual for level in prefix.levels])


def test_a_level_that_pulls_a_million_times_harder_moves_nothing_above():
    rng = np.random.default_rng(0)
    problem = three_level(rng, "mid")
    reference = solve(problem[:2])
    problem[2] = Rows(*(1e6 * part for part in equal(problem[2].A, 1e3 * problem[2].lower)))
    whole = solve(problem)
    assert_same_misses(problem[:2], whole.x, [level.residual for level in reference.levels])


@pytest.mark.parametrize("seed", range(40))
def test_limits_that_contain_zero_are_never_broken(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 12))
    width = rng.exponential(size=n)
    limits = [Rows(np.eye(n), -width * rng.integers(0, 2, n), width)]
    A = rng.standard_normal((5, n))
    limits.append(Rows(A, np.full(5, -INF), rng.exponential(size=5)))
    answer = solve([*limits, *fuzz_of_width(rng, n)])
    for rows, report in zip(limits, answer.levels, strict=False):
        assert report.status == "met"
        assert np.abs(report.residual).max() <= TOL * units(rows, answer.x)


def fuzz_of_width(rng, n):
    for _ in range(4):
        m = int(rng.integers(1, 7))
        A = rng.standard_normal((m, n)) * 10.0 ** rng.uniform(-3, 3)
        lower, upper = np.sort(10.0 * rng.standard_normal((2, m)), axis=0)
        yield Rows(A, lower, upper) if rng.random() < 0.3 else equal(A, upper)


# ---------------------------------------------------------------- the shortest of many


@pytest.mark.parametrize("m", [1, 3, 6])
def test_of_many_optima_the_shortest_is_returned(m, solver):
    rng = np.random.default_rng(m)
    A, b = rng.standard_normal((m, 7)), rng.standard_normal(m)
    answer = solve([equal(A, b)], solver)
    assert_same_point(answer.x, np.linalg.pinv(A) @ b)


def test_the_shortest_is_sought_within_the_limits(solver):
    wide = Rows(np.eye(2), np.array([-INF, -INF]), np.array([0.5, INF]))
    problem = [wide, equal([[1, 1]], [2])]  # without the limit: [1, 1]
    answer = solve(problem, solver)
    assert_same_point(answer.x, [0.5, 1.5])


@pytest.mark.parametrize("index", [135, 386, 533, 1495, 2081, 2273])
def test_rows_that_were_in_the_way_once_are_let_go_for_a_shorter_answer(index):
    """Problems in which rows that held x during the search leave no freedom if they are kept."""
    problem = general(np.random.default_rng(np.random.SeedSequence([5, index])))
    known, misses = lexicographic_optimum(problem)
    for solver in THREE:
        answer = solve(problem, solver)
        assert_same_misses(problem, answer.x, misses)
        assert_same_point(answer.x, known)


def test_nothing_asked_is_nothing_done(solver):
    problem = [box(3, 1.0), Rows(np.zeros((0, 3)), np.zeros(0), np.zeros(0))]
    answer = solve(problem, solver)
    np.testing.assert_array_equal(answer.x, np.zeros(3))
    assert not answer.limit_active


# ---------------------------------------------------------------- what cannot be met


def test_rows_that_contradict_one_another_share_the_miss(solver):
    problem = [Rows(np.ones((2, 1)), np.array([1.0, -INF]), np.array([INF, -1.0]))]
    answer = solve(problem, solver)
    assert_same_point(answer.x, [0])
    np.testing.assert_allclose(answer.levels[0].residual, [-1, 1], rtol=0, atol=TOL)
    assert answer.levels[0].status == "nearest"


def test_limits_at_two_levels_that_exclude_each_other_are_resolved(solver):
    """Limits that exclude each other: the first is kept, the second comes as near as it can."""
    outside = Rows(np.eye(2), np.array([2.0, -INF]), np.array([3.0, INF]))
    answer = solve([box(2, 1.0), outside, equal(np.eye(2), [0, 0.3])], solver)
    assert_same_point(answer.x, [1, 0.3])
    assert [level.status for level in answer.levels] == ["met", "nearest", "nearest"]
    assert answer.limit_active


@pytest.mark.parametrize(
    ("target", "statuses"),
    [(0.5, ["met", "met"]), (1.0, ["met", "met"]), (1.0 + 1e-6, ["met", "nearest"])],
)
def test_status_tells_met_from_nearest(target, statuses):
    answer = solve([box(2, 1.0), equal(np.eye(2), [target, 0])])
    assert [level.status for level in answer.levels] == statuses


def test_reports_carry_names_ranks_and_active_rows():
    rng = np.random.default_rng(0)
    levels = [
        Level(np.eye(11), np.full(11, -1e3), np.full(11, 1e3), name="range"),
        *(Level.equal(rng.standard_normal((m, 11)), np.ones(m), name=f"of {m}") for m in (3, 3)),
        Level.equal(np.eye(11), np.zeros(11), name="rest"),
    ]
    answer = HQP().solve(levels)
    assert [level.name for level in answer.levels] == ["range", "of 3", "of 3", "rest"]
    assert [level.rank for level in answer.levels] == [0, 3, 3, 5]
    np.testing.assert_array_equal(answer.active, [0] * 11 + [2] * 17)
    assert not answer.limit_active and not answer.failed


def test_active_rows_tell_which_bound_holds_x():
    answer = solve([box(3, 1.0), equal(np.eye(3), [5, -5, 0.5])])
    np.testing.assert_array_equal(answer.active, [1, -1, 0, 2, 2, 2])
    assert answer.limit_active
    assert [level.rank for level in answer.levels] == [2, 1]


# ---------------------------------------------------------------- warm start


@pytest.mark.parametrize("solver", THREE)
def test_a_warm_start_changes_the_way_and_not_the_answer(solver):
    hqp = HQP(solver=solver)
    for seed in range(10):
        rng = np.random.default_rng(seed)
        problem = three_level(rng, "hard")
        moved = [
            problem[0],
            *(equal(A, b + 0.01 * rng.standard_normal(len(b))) for A, b, _ in problem[1:]),
        ]
        cold, before = hqp.solve(built(problem)), hqp.solve(built(moved))
        for warm in (cold, before):
            again = hqp.solve(built(problem), warm=warm)
            assert again.is_optimal(built(problem))
            assert_same_point(again.x, cold.x)


@pytest.fixture
def made(monkeypatch):
    """The steps of each search."""
    steps, search = [], active_set.search

    def counted(*arguments):
        found = search(*arguments)
        steps.append(found[-2])
        return found

    monkeypatch.setattr(active_set, "search", counted)
    return steps


@pytest.mark.parametrize("solver", THREE)
def test_a_warm_start_from_its_own_answer_needs_one_step(made, solver):
    levels = built(three_level(np.random.default_rng(0), "hard"))
    cold = HQP("active-set").solve(levels)
    assert (np.abs(cold.active) == 1).any() and made.pop() > 1
    again = HQP(solver).solve(levels, warm=cold)
    assert made == [0]
    assert again.method == "active-set" and again.failed == ()


@pytest.mark.parametrize("solver", THREE)
def test_a_warm_start_that_does_not_fit_is_dropped_after_a_few_steps(made, solver):
    """Steps from there are no shorter than from nothing, and there may be hundreds."""
    problem = forces(np.random.default_rng(0), 8, 8)
    cold = solve(problem, solver)
    misleading = dataclasses.replace(cold, active=np.where(cold.active == 2, 2, 1).astype(np.int8))
    made.clear()
    again = HQP(solver).solve(built(problem), warm=misleading)
    assert made[0] == ROUNDS and len(made) == 2
    assert again.failed == (f"active-set: not settled from the warm start in {ROUNDS} steps",)
    assert again.method == solver
    np.testing.assert_array_equal(again.x, cold.x)


def test_a_warm_start_from_another_problem_does_no_harm():
    rng = np.random.default_rng(0)
    problem = three_level(rng, "mid")
    cold = solve(problem)
    misleading = solve([problem[0], *(equal(A, -20 * b) for A, b, _ in problem[1:])])
    sided = Solution(cold.x, (), np.full(28, 1, np.int8), np.zeros((28, 4)), "made up")
    shorter = solve(problem[:2])
    for warm in (misleading, sided, shorter):
        again = HQP("active-set").solve(built(problem), warm=warm)
        assert again.certified
        assert_same_point(again.x, cold.x)


@pytest.mark.parametrize("solver", THREE)
@pytest.mark.parametrize("warm", [np.zeros(2), [0, 1], "warm", 5, box(2, 1.0)])
def test_a_warm_start_that_is_no_solution_is_refused_by_name(solver, warm):
    with pytest.raises(InputError, match=f"warm must be the Solution .* {type(warm).__name__}"):
        HQP(solver).solve(built([box(2, 1.0)]), warm=warm)


def test_a_warm_start_never_holds_a_row_at_an_infinite_bound():
    one_sided = Rows(np.eye(3), np.full(3, -INF), np.ones(3))
    levels = built([one_sided, equal(np.eye(3), [2, 0, 0])])
    warm = Solution(np.zeros(3), (), np.full(6, -1, np.int8), np.zeros((6, 2)), "made up")
    assert_same_point(HQP("active-set").solve(levels, warm=warm).x, [1, 0, 0])


# ---------------------------------------------------------------- proxqp means proxqp


@pytest.fixture
def proxsuite_calls(monkeypatch):
    calls = []
    QP = proxsuite.proxqp.dense.QP
    solve = QP.solve

    def counted(self, *arguments):
        calls.append(self)
        return solve(self, *arguments)

    monkeypatch.setattr(QP, "solve", counted)
    return calls


@pytest.mark.parametrize(
    "problem",
    [
        three_level(np.random.default_rng(0), "easy"),
        three_level(np.random.default_rng(0), "hard"),
        [equal(np.eye(3), np.ones(3)), box(3, 2.0)],
        [equal([[1, 2]], [3])],
        [box(3, 1.0)],
    ],
    ids=["easy", "hard", "limits last", "no limits", "limits only"],
)
def test_proxqp_is_solved_by_proxsuite(proxsuite_calls, problem):
    answer = solve(problem, "proxqp")
    assert answer.method == "proxqp" and not answer.failed
    assert proxsuite_calls
    assert_same_point(answer.x, lexicographic_optimum(problem)[0])


def test_a_level_below_nothing_but_equalities_needs_no_solver(proxsuite_calls):
    rng = np.random.default_rng(0)
    solve([equal(rng.standard_normal((2, 7)), np.ones(2)) for _ in range(3)], "proxqp")
    assert len(proxsuite_calls) == 1  # the first, so that proxqp is what it says


@pytest.mark.parametrize("solver", [name for name in solvers() if name != "proxqp"])
def test_no_other_solver_asks_proxsuite(proxsuite_calls, solver):
    answer = solve(three_level(np.random.default_rng(0), "easy"), solver)
    assert answer.method == solver, answer.failed
    assert not proxsuite_calls


def test_an_answer_does_not_depend_on_what_was_solved_before():
    problems = [three_level(np.random.default_rng(seed), "hard") for seed in range(20)]
    first = [solve(problem).x for problem in problems]
    for problem, x in reversed(list(zip(problems, first, strict=True))):
        np.testing.assert_array_equal(solve(problem).x, x)
    with ThreadPoolExecutor(4) as pool:
        for x, again in zip(first, pool.map(lambda p: solve(p).x, problems), strict=True):
            np.testing.assert_array_equal(again, x)


# ---------------------------------------------------------------- solvers that fail


def raising(error):
    def backend(P, q, G, lower, upper):
        raise error

    return backend


def answering(value):
    def backend(P, q, G, lower, upper):
        return np.full(len(q), value), np.full(len(G), value)

    return backend


@pytest.mark.parametrize(
    "backend",
    [
        raising(qp_solvers.QPSolverError("gave up")),
        raising(RuntimeError("crashed")),
        raising(ValueError("did not like the matrix")),
        raising(np.linalg.LinAlgError("singular")),
        raising(ZeroDivisionError("division by zero")),
        answering(np.nan),
        answering(INF),
    ],
    ids=["gives up", "RuntimeError", "ValueError", "LinAlgError", "ZeroDivision", "nan", "inf"],
)
@pytest.mark.parametrize("solver", ["proxqp", "daqp"])
def test_a_solver_that_fails_is_named_and_the_answer_is_right(monkeypatch, solver, backend):
    monkeypatch.setitem(qp_solvers.BACKENDS, solver, backend)
    for seed in range(3):
        problem = three_level(np.random.default_rng(seed), "hard")
        x, _ = lexicographic_optimum(problem)
        answer = solve(problem, solver)
        assert_same_point(answer.x, x)
        assert answer.method != solver
        assert any(reason.startswith(solver) for reason in answer.failed)


@pytest.mark.parametrize("value", [0.0, 1.0, -1.0, 1e9, -1e30, 1e300])
def test_a_solver_that_answers_nonsense_does_no_harm(monkeypatch, value):
    monkeypatch.setitem(qp_solvers.BACKENDS, "proxqp", answering(value))
    for difficulty in ("easy", "mid", "hard"):
        problem = three_level(np.random.default_rng(5), difficulty)
        x, _ = lexicographic_optimum(problem)
        answer = solve(problem)
        assert_same_point(answer.x, x)
        assert answer.method == "proxqp" or "proxqp" in answer.failed[0]


def test_a_solver_that_answers_at_random_does_no_harm(monkeypatch):
    rng = np.random.default_rng(0)

    def dice(P, q, G, lower, upper):
        return rng.standard_normal(len(q)), rng.standard_normal(len(G))

    monkeypatch.setitem(qp_solvers.BACKENDS, "daqp", dice)
    for seed in range(10):
        problem = fuzz(4000 + seed, max_n=8, max_levels=4, max_rows=5, scales=False)
        answer = solve(problem, "daqp")
        assert_same_misses(problem, answer.x, lexicographic_optimum(problem)[1])


def searching(monkeypatch, failures):
    """The first `failures` searches find nothing but x = 0."""
    left, search = [failures], active_set.search

    def first_in_vain(rows, act, *arguments):
        if left[0] == 0:
            return search(rows, act, *arguments)
        left[0] -= 1
        M, n, p = *rows.A.shape, len(rows.frobenius)
        return np.zeros(n), np.zeros((M, p + 1)), np.zeros(p, np.int64), 0, 1

    monkeypatch.setattr(active_set, "search", first_in_vain)


def test_before_an_uncertified_answer_goes_out_the_other_solvers_are_asked(monkeypatch):
    problem = three_level(np.random.default_rng(0), "hard")
    x, _ = lexicographic_optimum(problem)
    for solver, failures, ways in (
        ("active-set", 1, ["active-set", "daqp"]),
        ("active-set", 2, ["active-set", "daqp", "proxqp"]),
        ("proxqp", 2, ["proxqp", "active-set", "daqp"]),
        ("daqp", 2, ["daqp", "active-set", "proxqp"]),
        ("daqp", 4, ["daqp", "active-set", "proxqp", "coarser rank", "one row at a time"]),
    ):
        with monkeypatch.context() as patched:
            searching(patched, failures)
            answer = solve(problem, solver)
        assert [*(fault.split(":")[0] for fault in answer.failed), answer.method] == ways
        assert_same_point(answer.x, x)


LANDING = np.load(Path(__file__).with_name("landing.npz"))


@pytest.mark.parametrize("k", CONTACTS)
def test_the_search_by_itself_finds_the_forces_of_any_number_of_contacts(k):
    """Once 0 of 40 of eight contacts: many rows at a bound at once, m ≫ n."""
    for seed in range(12):
        answer = solve(forces(np.random.default_rng([k, seed]), k), "active-set")
        assert answer.method == "active-set", (seed, answer.failed)


def test_the_search_by_itself_finds_a_step_of_many_joints_at_their_limits():
    for seed in range(40):
        problem = joints(np.random.default_rng(seed))
        answer = solve(problem, "active-set")
        assert answer.method == "active-set", (seed, answer.failed)
        for level in built(problem[:2]):
            assert np.abs(level.residual(answer.x)).max() <= TOL * units(level, answer.x)


@pytest.mark.parametrize("k", [3, 8])
def test_forces_are_the_same_whoever_finds_them(k):
    for seed in range(4):
        problem = forces(np.random.default_rng([9, k, seed]), k, edges=8)
        found = [solve(problem, name).x for name in THREE]
        for x in found[1:]:
            assert_same_point(x, found[0])


def test_a_correction_of_43_joints_at_many_bounds_at_once_keeps_its_limits(solver):
    """Levels of a step's landing, once answered 0.036 rad outside a range that x = 0 keeps."""
    problem = [Rows(v[:, :-2], v[:, -2], v[:, -1]) for v in LANDING.values()]
    answer = solve(problem, solver)
    assert answer.method == solver, answer.failed
    for level in built(problem[:3]):
        assert np.abs(level.residual(np.zeros(43))).max() == 0.0
        assert np.abs(level.residual(answer.x)).max() <= TOL * units(level, answer.x)


# ---------------------------------------------------------------- invariance


def turned(problem, Q):
    return [Rows(A @ Q, lower, upper) for A, lower, upper in problem]


@pytest.mark.parametrize("difficulty", ["easy", "mid", "hard"])
def test_what_must_not_matter_does_not(difficulty):
    for seed in range(5):
        rng = np.random.default_rng(seed)
        problem = three_level(rng, difficulty)
        x = solve(problem).x
        # the unit of a level, beyond all sense
        weights = 10.0 ** rng.uniform(-6, 6, size=len(problem))
        scaled = [
            Rows(*(s * part for part in rows)) for s, rows in zip(weights, problem, strict=True)
        ]
        assert_same_point(solve(scaled).x, x)
        # the order of rows within a level
        shuffled = [
            Rows(*(part[order] for part in rows))
            for rows, order in ((rows, rng.permutation(len(rows.A))) for rows in problem)
        ]
        assert_same_point(solve(shuffled).x, x)
        # the sign of rows
        negated = [Rows(-A, -upper, -lower) for A, lower, upper in problem]
        assert_same_point(solve(negated).x, x)
        # asking again, lower down, for what a level above has decided
        assert_same_point(solve([*problem, problem[1], problem[0]]).x, x)
        # limits too far away to be felt, and rows without bounds
        far = Rows(problem[1].A, np.full(3, -1e3), np.full(3, INF))
        assert_same_point(solve([problem[0], far, *problem[1:]]).x, x)


@pytest.mark.parametrize("factor", [1e-6, 1e-3, 1e3, 1e6])
def test_targets_scale_the_answer(factor):
    for difficulty in ("easy", "mid", "hard"):
        problem = three_level(np.random.default_rng(1), difficulty)
        far = [Rows(A, factor * lower, factor * upper) for A, lower, upper in problem]
        assert_same_point(solve(far).x / factor, solve(problem).x)


@pytest.mark.parametrize("seed", range(10))
def test_turning_the_axes_turns_the_answer(seed):
    rng = np.random.default_rng(seed)
    problem = three_level(rng, ("mid", "hard")[seed % 2])
    Q = np.linalg.qr(rng.standard_normal((11, 11)))[0]
    assert_same_point(Q @ solve(turned(problem, Q)).x, solve(problem).x)


def test_answers_repeat_to_the_bit():
    for seed in range(10):
        problem = fuzz(5000 + seed)
        np.testing.assert_array_equal(solve(problem).x, solve(problem).x)


def test_levels_are_not_changed_by_solving_them():
    problem = three_level(np.random.default_rng(0), "hard")
    before = [[part.copy() for part in rows] for rows in problem]
    solve(problem)
    for rows, copy in zip(problem, before, strict=True):
        for part, same in zip(rows, copy, strict=True):
            np.testing.assert_array_equal(part, same)


# ---------------------------------------------------------------- near a loss of rank


@pytest.mark.parametrize("agree", [False, True])
@pytest.mark.parametrize("angle", ANGLES, ids="{:.0e}".format)
def test_nearly_parallel_levels_are_answered_within_their_limits(angle, agree):
    for seed in range(3):
        problem = near_singular(np.random.default_rng(seed), angle, agree=agree)
        _, misses = lexicographic_optimum(problem)
        for solver in THREE:
            answer = solve(problem, solver)
            assert np.abs(answer.x).max() <= 0.25 * (1.0 + TOL)
            # Where x jumps, its posture does: compare what is asked before it.
            assert_same_misses(problem[:3], answer.x, misses[:3])


@pytest.mark.parametrize("tolerance", [1e-12, 1e-8, 1e-4, 1e-2])
@pytest.mark.parametrize("angle", ANGLES[::2], ids="{:.0e}".format)
def test_any_rank_tolerance_gives_a_certified_answer_within_the_limits(angle, tolerance):
    for seed in range(3):
        problem = near_singular(np.random.default_rng(seed), angle)
        answer = solve(problem, rank_tolerance=tolerance)
        assert np.abs(answer.x).max() <= 0.25 * (1.0 + TOL)


@pytest.mark.parametrize("damping", [1e-8, 1e-4, 1.0])
@pytest.mark.parametrize("angle", ANGLES[::2], ids="{:.0e}".format)
def test_damped_levels_are_certified_and_stay_within_the_limits(angle, damping):
    for seed in range(3):
        levels = HQP().damped(built(near_singular(np.random.default_rng(seed), angle)), damping)
        answer = HQP().solve(levels)
        assert answer.is_optimal(levels)
        assert np.abs(answer.x).max() <= 0.25 * (1.0 + TOL)


def test_damping_weighs_the_miss_of_a_level_against_the_length_of_x():
    """min (x₁ + x₂ − 2)² + λ ‖x‖² with x₂ ≤ 0.1, by hand: x₁ = (2 − 0.1) / (1 + λ)."""
    damping = 0.5
    limit = Level([[0.0, 1.0]], [-INF], [0.1])
    levels = HQP().damped([limit, Level.equal([[1.0, 1.0]], [2.0], "sum")], damping)
    assert levels[0] is limit and levels[1].name == "sum, damped"
    assert_same_point(HQP().solve(levels).x, [1.9 / (1.0 + damping), 0.1])


def test_a_damped_level_admits_what_its_own_inequalities_were_left_with():
    """min (x − 1)² + (x + 1)²₊ + λ x², the second for x ≤ −1, by hand: x = 0."""
    levels = HQP().damped([Level([[1.0], [1.0]], [1.0, -INF], [1.0, -1.0])], 0.1)
    assert_same_point(HQP().solve(levels).x, [0.0])
    assert levels[0].upper[1] == pytest.approx(0.0, abs=TOL) and levels[0].lower[1] == -INF


def test_damped_levels_are_not_built_on_an_answer_that_is_not_certified(alone):
    problem = scaling(np.random.default_rng(0), 30, 6)
    with pytest.raises(SolverError, match="not certified, and so not used"):
        HQP("active-set", budget=1).damped(built(problem), 1e-3)


def test_each_level_may_have_a_damping_of_its_own():
    levels = [Level.equal([[1.0, 0.0]], [1.0]), Level.equal([[0.0, 1.0]], [1.0])]
    held = HQP().damped(levels, [0.0, 1.0], reference=[0.0, 3.0])
    assert held[0] is levels[0]
    assert_same_point(HQP().solve(held).x, [1.0, 2.0])


def test_what_is_held_back_may_be_another_motion_than_x():
    """min (x − 2)² + λ ‖(x, 2x) − (3, 6)‖², by hand: x = (2 + 15 λ) / (1 + 5 λ)."""
    level, M = Level.equal([[1.0]], [2.0]), np.array([[1.0], [2.0]])
    held = HQP().damped([level], 0.5, motion=M)
    assert_same_point(HQP().solve(held).x, [2.0 / 3.5])
    held = HQP().damped([level], 0.5, reference=[3.0], motion=M)
    assert_same_point(HQP().solve(held).x, [9.5 / 3.5])


def test_the_rank_tolerance_decides_what_counts_as_independent():
    problem = near_singular(np.random.default_rng(0), 1e-6, limits=False)
    strict, truncated = solve(problem), solve(problem, rank_tolerance=1e-3)
    assert [level.rank for level in strict.levels] == [3, 3, 5]
    assert [level.rank for level in truncated.levels] == [3, 0, 8]
    assert np.linalg.norm(strict.x) > 1e3 > np.linalg.norm(truncated.x)
    assert strict.levels[1].status == "met" and truncated.levels[1].status == "nearest"


def test_rows_that_differ_in_the_last_digit_and_contradict_each_other_share_the_miss():
    """The second row knows x₂ … x₇ by 1e-16 only: below the rank of its level."""
    noise = 1e-16 * np.random.default_rng(0).standard_normal(7)
    answer = solve([equal([np.eye(7)[0], np.eye(7)[0] + noise], [1.0, -1.0])])
    assert_same_point(answer.x, np.zeros(7))
    assert answer.levels[0].rank == 1


def test_an_answer_that_is_not_shown_to_be_the_shortest_is_not_withheld(monkeypatch):
    judge = hqp_module.optimality

    def never_the_shortest(rows, *arguments, **options):
        found = judge(rows, *arguments, **options)
        return found._replace(faults={**found.faults, 2: (9.0, "least norm of x: not shown")})

    monkeypatch.setattr(hqp_module, "optimality", never_the_shortest)
    levels = built([box(3, 1.0), equal([[1.0, 1.0, 1.0]], [1.5])])
    answer = HQP().solve(levels)
    assert answer.certified and answer.is_optimal(levels)
    assert_same_point(answer.x, [0.5, 0.5, 0.5])
    assert all("least norm" in fault for fault in answer.failed) and answer.failed


def dusty(rng, size):
    """Limits, a level with a row of dust that asks for 1, and two levels below; and without it."""
    n = 9
    A, dust = rng.standard_normal((2, n)), size * rng.standard_normal((1, n))
    below = [equal(rng.standard_normal((3, n)), rng.standard_normal(3)) for _ in range(2)]
    asked = rng.standard_normal(2)
    level = equal(np.concatenate([A[:1], dust, A[1:]]), [asked[0], 1.0, asked[1]])
    return [box(n, 0.3), level, *below], [box(n, 0.3), equal(A, asked), *below]


@pytest.mark.parametrize("solver", THREE)
@pytest.mark.parametrize(("size", "tolerance"), [(1e-16, None), (1e-14, 1e-12), (1e-9, 1e-6)])
def test_a_row_below_the_rank_of_its_level_asks_for_nothing_and_holds_nothing(
    solver, size, tolerance
):
    for seed in range(20):
        with_dust, without = dusty(np.random.default_rng(seed), size)
        answer = solve(with_dust, solver, rank_tolerance=tolerance)
        assert answer.method == solver
        assert answer.levels[1].status == "nearest" and answer.levels[1].rank <= 2
        np.testing.assert_allclose(answer.x, solve(without).x, rtol=0, atol=10 * size + TOL)


@pytest.mark.parametrize("tolerance", [None, 1e-12, 1e-6, 1e-3])
def test_hierarchy_and_projection_agree_on_what_is_below_the_rank(tolerance):
    for seed in range(20):
        _, *levels = built(dusty(np.random.default_rng(seed), 1e-16)[0])
        answer = HQP(rank_tolerance=tolerance).solve(levels)
        projected = Projection(rank_tolerance=tolerance).solve(levels)
        assert_same_point(answer.x, projected.x)
        assert [v.rank for v in answer.levels] == [v.rank for v in projected.levels]


GRASPS = np.load(Path(__file__).with_name("parallel_normals.npz"))


@pytest.mark.parametrize("solver", THREE)
@pytest.mark.parametrize("grasp", range(6))
def test_grasps_with_parallel_normals_are_answered(solver, grasp):
    """Steps of trials on boxes that once ended in SolverError: a force of 1 N asked of dust."""
    levels = [
        Level(v[:, :-2], v[:, -2], v[:, -1])
        for name, v in GRASPS.items()
        if name.startswith(f"{grasp}_")
    ]
    answer = HQP(solver, rank_tolerance=1e-6).solve(levels)
    assert answer.certified and answer.is_optimal(levels)
    assert answer.method == solver


# ---------------------------------------------------------------- best effort


@pytest.fixture
def alone(monkeypatch):
    """No other solver is asked."""
    monkeypatch.setattr(hqp_module, "OTHERS", ())


def test_an_answer_beyond_the_budget_says_that_it_is_not_certified(alone):
    levels = built(scaling(np.random.default_rng(0), 30, 6))
    hasty, sound = HQP("active-set", budget=1).solve(levels), HQP("active-set").solve(levels)
    assert sound.certified and not sound.failed
    assert not hasty.certified and not hasty.is_optimal(levels)
    assert np.isfinite(hasty.x).all()
    assert len(hasty.failed) == 3 and all("imbalance" in fault for fault in hasty.failed)


def test_the_best_effort_is_the_same_to_the_bit_each_time(alone):
    levels = built(scaling(np.random.default_rng(1), 30, 6))
    first, again = (HQP("active-set", budget=1).solve(levels) for _ in range(2))
    np.testing.assert_array_equal(first.x, again.x)


def test_of_uncertified_answers_the_one_that_serves_most_levels_is_returned(alone, monkeypatch):
    tries = iter([[2.0, 0.0], [0.5, 0.0], [3.0, 3.0], [np.nan, 0.5]])

    def fake(rows, act, *_):
        return np.array(next(tries)), np.zeros((len(act), 3)), np.zeros(2, np.int64), 1, 1

    monkeypatch.setattr(active_set, "search", fake)
    answer = HQP("daqp").solve(built([box(2, 1.0), equal(np.eye(2), [0.5, 0.5])]))
    np.testing.assert_array_equal(answer.x, [0.5, 0.0])
    assert not answer.certified and len(answer.failed) == 4


def test_only_where_nothing_finite_is_found_is_there_no_answer(monkeypatch):
    def fake(rows, act, *_):
        return np.full(2, np.nan), np.zeros((len(act), 3)), np.zeros(2, np.int64), 1, 1

    monkeypatch.setattr(active_set, "search", fake)
    with pytest.raises(SolverError, match="no way led to a finite x"):
        HQP("daqp").solve(built([box(2, 1.0), equal(np.eye(2), [0.5, 0.5])]))


@pytest.mark.parametrize("seed", range(60))
def test_anything_with_dust_and_a_rank_tolerance_is_answered(seed):
    problem, tolerance = anything(np.random.default_rng(np.random.SeedSequence([8, seed])))
    solve(problem, THREE[seed % 3], rank_tolerance=tolerance)


@pytest.mark.parametrize("budget", [0, -1, np.nan, INF, 10**30])
def test_a_budget_that_is_none_is_refused(budget):
    with pytest.raises(InputError, match="budget must be above 0"):
        HQP(budget=budget)


def test_levels_exactly_parallel_are_one_level_and_a_miss():
    rng = np.random.default_rng(0)
    A, b = rng.standard_normal((3, 7)), rng.standard_normal(3)
    mix = rng.standard_normal((3, 3))
    answer = solve([equal(A, b), equal(mix @ A, np.zeros(3))])
    assert_same_point(answer.x, np.linalg.pinv(A) @ b)
    assert [level.rank for level in answer.levels] == [3, 0]
    assert [level.status for level in answer.levels] == ["met", "nearest"]


# ---------------------------------------------------------------- bad input


def test_an_unknown_solver_is_refused_with_the_list_of_those_known():
    with pytest.raises(InputError, match="unknown solver 'simplex'") as refusal:
        HQP(solver="simplex")
    for name in solvers():
        assert name in str(refusal.value)


def test_proxqp_is_the_default_and_the_list_names_no_solver_twice():
    assert HQP().solver == "proxqp"
    assert {"proxqp", "daqp"} <= set(solvers())
    assert len(set(solvers())) == len(solvers())
    assert hqp_grasp.solvers() == solvers()


@pytest.mark.parametrize("tolerance", [-1e-9, 1.0, 2.0, np.nan, INF])
def test_a_rank_tolerance_out_of_range_is_refused(tolerance):
    with pytest.raises(InputError, match="rank_tolerance must lie in"):
        HQP(rank_tolerance=tolerance)


@pytest.mark.parametrize("wrong", ["much", None, [1.0, 2.0], {}])
def test_settings_that_are_no_numbers_are_refused_by_name(wrong):
    cases = [(HQP, "budget"), (Projection, "damping")]
    if wrong is not None:
        cases += [(HQP, "rank_tolerance"), (Projection, "rank_tolerance")]
    for kind, setting in cases:
        with pytest.raises(InputError, match=f"{setting} must be a number"):
            kind(**{setting: wrong})


@pytest.mark.parametrize("damping", [-1e-9, np.nan, INF, [0.1, -1.0], [0.1], [[0.1, 0.1]]])
def test_damping_that_is_no_damping_is_refused(damping):
    levels = built([box(2, 1.0), equal(np.eye(2), np.ones(2))])
    with pytest.raises(InputError, match=r"damping must be ≥ 0, one number or one for each level"):
        HQP().damped(levels, damping)


@pytest.mark.parametrize("reference", [[0.0], [0.0, np.nan], 1.0, "here"])
def test_a_reference_that_is_no_point_is_refused(reference):
    with pytest.raises(InputError, match="reference must be 2 finite numbers"):
        HQP().damped(built([box(2, 1.0)]), 0.1, reference)


@pytest.mark.parametrize("motion", [[1.0, 1.0], [[1.0]], [[np.nan, 1.0]], 1.0, "all"])
def test_a_motion_that_is_no_matrix_over_the_unknowns_is_refused(motion):
    with pytest.raises(InputError, match="motion must be finite rows over 2 unknowns"):
        HQP().damped(built([box(2, 1.0)]), 0.1, motion=motion)


def test_levels_of_different_width_are_refused_with_their_widths():
    with pytest.raises(InputError, match=r"number of unknowns: \[2, 3\]"):
        HQP().solve(built([box(2, 1.0), box(3, 1.0)]))


def test_one_level_is_a_hierarchy():
    level = Level.equal(np.eye(2), [1.0, 2.0])
    answer = HQP().solve(level)
    assert_same_point(answer.x, [1.0, 2.0])
    assert answer.is_optimal(level)
    assert_same_point(HQP().solve(HQP().damped(level, 1.0)).x, [0.5, 1.0])


@pytest.mark.parametrize("levels", [5, [np.eye(2)], "levels", [None]])
def test_what_is_no_level_is_refused_by_name(levels):
    with pytest.raises(InputError, match=r"levels must be hg\.Level objects"):
        HQP().solve(levels)


def test_a_hierarchy_without_levels_is_refused():
    with pytest.raises(InputError, match="at least one level"):
        HQP().solve([])


def test_an_hqp_cannot_be_changed():
    with pytest.raises(AttributeError):
        HQP().solver = "daqp"
