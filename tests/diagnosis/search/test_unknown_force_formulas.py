"""Forces of no known form against their formulas."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from concent_warp.diagnosis.candidates.candidate import ScreenedCandidate
from concent_warp.diagnosis.candidates.null_distribution import max_gain_under_null, null_p_value
from concent_warp.diagnosis.cfg import DiagnoseCfg, UnknownForceCfg
from concent_warp.diagnosis.search import unknown_force as module
from concent_warp.diagnosis.search.unknown_force import (
    _best_force,
    _body_forces,
    _listed,
    _spread_out,
    _with_prior,
    combined,
    unknown_force,
    with_interleaved_folds,
)
from concent_warp.effects.unknown_force import UnknownBodyForce, UnknownForce
from concent_warp.fit.effects.cross_validation import HeldOut, block_sums
from tests.diagnosis.candidates.random_models import (
    ANY,
    COUNT,
    LIMIT,
    ROWS,
    base_of,
    blocks,
    pieces,
    screened_of,
)


def test_folds_of_forces_are_dealt_in_turn():
    base = base_of(blocks=replace(blocks(), fold=np.zeros(COUNT, int)))
    found = with_interleaved_folds(base)
    assert found.blocks.fold.tolist() == [0, 1, 2, 3, 4, 0, 1, 2]
    expected = HeldOut(block_sums(base.pieces, found.blocks, LIMIT), found.blocks, 10.0).own()
    np.testing.assert_allclose(found.errors, expected)


def test_priors_of_forces_expect_the_same_of_each_basis_function():
    base, s = base_of(), screened_of(1, 4)
    parts = [replace(p, jacobian=p.jacobian * np.array([1, 1, 1e-6, 1, 1])) for p in s.pieces]
    found = _with_prior(base, replace(s, pieces=tuple(parts)), 0.3)
    square = np.sum([(p.jacobian**2).sum(axis=0) for p in found.pieces], axis=0)
    each = 0.3 * base.errors.sum() / 3 / 100
    np.testing.assert_allclose(square[1:], [each, 0, each, each])
    for p, q in zip(found.pieces, parts, strict=True):
        np.testing.assert_array_equal(p.jacobian[:, 0], q.jacobian[:, 0])
    both = combined(base, [s, screened_of(2, 2)], 0.3)
    assert both.pieces[0].jacobian.shape == (ROWS, 1 + 4 + 2)
    square = np.sum([(p.jacobian**2).sum(axis=0) for p in both.pieces], axis=0)
    half = 0.15 * base.errors.sum() / 100
    np.testing.assert_allclose(square[1:], [*[half / 4] * 4, *[half / 2] * 2])
    np.testing.assert_array_equal(both.pieces[1].jacobian[:, 0], s.pieces[1].jacobian[:, 0])


def test_points_are_spread_out_from_their_middle():
    points = np.array([[0.0, 0, 0], [1, 0, 0], [3, 0, 0], [3, 4, 0], [0.5, 0, 0], [1, 0.2, 0]])
    chosen, width = _spread_out(points, 3)
    np.testing.assert_array_equal(chosen, [[1, 0, 0], [3, 4, 0], [3, 0, 0]])
    assert width == pytest.approx(2.0)
    same, none = _spread_out(np.ones((5, 3)), 4)
    assert same.tolist() == [[1, 1, 1]]
    assert none < 1e-4
    every, _ = _spread_out(points, 20)
    assert len(every) == 6


BALL = """<mujoco><option gravity="0 0 -5"/><worldbody><body name="pole"><joint name="turn"/><geom size=".1"/></body>
  <body name="ball"><freejoint/><geom size=".1" mass="2"/>
    <body><joint name="x"/><geom size=".1" mass="1"/></body></body></worldbody></mujoco>"""


def test_forces_on_a_body_cover_where_it_was_and_how_fast():
    m, rng, cfg = mujoco.MjModel.from_xml_string(BALL), np.random.default_rng(0), UnknownForceCfg()
    qpos, qvel = rng.normal(size=(200, m.nq)), rng.normal(size=(200, m.nv))
    body = m.body("ball").id
    found: Any = _body_forces(m, body, qpos, qvel, cfg)
    assert [f.words for f in found] == [
        "a force that depends on the position of ball", "a resistance that depends on the position of ball",
        "a resistance that depends on the speed of ball", "a resistance that depends on the rate of turning of ball",
    ]  # fmt: skip
    models = [f.force_model(m) for f in found]
    assert [f.way for f in models] == ["field", "brake", "drag", "turning"]
    assert {(f.body, f.place, f.dof) for f in models} == {(body, 1, 1)}
    force = 0.1 * 3 * 5
    assert [f.scale for f in models] == pytest.approx([force, force, force, 0.05 * force])
    centre, width = _spread_out(qpos[:, 1:4], 12)
    for f in models[:2]:
        np.testing.assert_array_equal(f.centre, centre)
        assert f.width == width
    for f, values in zip(models[2:], (qvel[:, 1:4], qvel[:, 4:7]), strict=True):
        high = np.percentile(np.linalg.norm(values, axis=1), 99.5)
        np.testing.assert_allclose(f.centre[:, 0], np.linspace(0, high, 5))
        assert f.width == pytest.approx(high / 4)
    still = _body_forces(m, body, np.ones((9, m.nq)), 0 * qvel[:9], cfg)
    assert still == []
    slow = 0 * qvel[:9]
    slow[:, 4] = 0.1
    turning: Any = _body_forces(m, body, np.ones((9, m.nq)), slow, cfg)
    assert [f.force_model(m).way for f in turning] == ["turning"]
    weightless = mujoco.MjModel.from_xml_string(BALL.replace("0 0 -5", "0 0 -.5"))
    light: Any = _body_forces(weightless, body, qpos, qvel, cfg)
    assert light[0].force_model(m).scale == pytest.approx(0.3)
    assert _listed(m, np.array([0])) == "turn"
    assert _listed(m, np.array([0, 2])) == "each of 2 joints"


class Node(SimpleNamespace):
    """A fitted model of some noise ratio and number of effects."""


def chain(*ratios: float, engines: tuple[str, ...] = ("mujoco", "warp"), counts: Any = None) -> list[Any]:
    """Return fitted models after each addition."""
    added = SimpleNamespace(effect=SimpleNamespace(engines=engines))
    counts = range(len(ratios)) if counts is None else counts
    return [Node(ratio=r, model=SimpleNamespace(effects=[added] * k)) for r, k in zip(ratios, counts, strict=True)]


def test_forces_are_tested_on_the_last_model_and_against_the_effects_added_before(monkeypatch):
    cfg, asked = DiagnoseCfg(), []

    def best(base, rival, lacked, *_):
        asked.append((base.ratio, None if rival is None else rival.ratio, lacked))
        return answers.pop(0) if answers else None

    monkeypatch.setattr(module, "_best_force", best)
    monkeypatch.setattr(module, "discrepancies", lambda *both: tuple(one.ratio**2 - 1 for one in both))
    answers: list[Any] = []
    nodes = chain(3.0, 2.0, 1.5, 1.1)
    assert unknown_force(nodes, cfg, ANY) is None
    assert asked == [(1.1, None, 8.0), (1.5, 1.1, 8.0), (2.0, 1.5, 8.0)]
    asked.clear()
    large, small = SimpleNamespace(form_error=False), SimpleNamespace(form_error=True)
    for given, expected, count in (
        ([large], large, 1),
        ([None, large], large, 2),
        ([small, large], large, 2),
        ([small, None, None], small, 3),
        ([small, small, small], small, 3),
        ([None, small, small], None, 3),
    ):
        asked.clear()
        answers[:] = given
        assert unknown_force(nodes, cfg, ANY) is expected
        assert len(asked) == count
    asked.clear()
    unknown_force(chain(1.01), cfg, ANY)
    assert asked == []
    for ratios in ((1.015,), (1.0, 1.2)):
        asked.clear()
        unknown_force(chain(*ratios), cfg, ANY)
        assert asked[0] == (ratios[-1], None, pytest.approx(max(ratios[-1] ** 2 - 1, 0.03)))
    asked.clear()
    unknown_force(chain(1.0, 1.01, 1.0), cfg, ANY)
    assert asked == [(1.01, 1.0, 0.03)]
    asked.clear()
    assert unknown_force(chain(3.0, 1.2, engines=("warp",)), cfg, ANY) is None
    assert asked == []
    unknown_force(chain(3.0, 1.2, 1.1, counts=(0, 2, 1)), cfg, ANY)
    assert asked == [(1.1, None, 8.0)]


def test_the_best_force_must_be_large_and_significant(monkeypatch):
    model = base_of()
    force = UnknownForce("a force", UnknownBodyForce(1, 0, 0, np.zeros((1, 3)), 1.0, 1.0, "brake"))
    other = UnknownForce("another", UnknownBodyForce(1, 0, 0, np.zeros((1, 3)), 1.0, 1.0, "brake"))
    parts = tuple(
        replace(p, jacobian=np.hstack([p.jacobian, (p.residual + 0.2 * q.residual)[:, None]]))
        for p, q in zip(model.pieces, pieces(7, 1), strict=True)
    )
    explains = ScreenedCandidate(force, 0.1, 0.0, np.zeros(2), parts)
    useless = replace(screened_of(9, 1, other))
    monkeypatch.setattr(module, "forces", lambda *_: [other, force])
    cfg = DiagnoseCfg()

    def results(_task, tasks):
        assert len(tasks) == 2
        return [useless, explains]

    found = _best_force(model, None, 1.0, cfg, results)
    assert found is not None
    assert found.words == "a force"
    assert found.instead is None
    again = with_interleaved_folds(replace(model, engine="mujoco"))
    tried = [_with_prior(again, s, x) for s in (useless, explains) for x in (0.02, 0.1, 0.5)]
    tried += [combined(again, [useless, explains], x) for x in (0.02, 0.1, 0.5)]
    errors = [
        HeldOut(block_sums([replace(p, residual=b.residual) for p, b in zip(s.pieces, again.pieces, strict=True)],
                           again.blocks, LIMIT), again.blocks, 10.0).own().sum() for s in tried
    ]  # fmt: skip
    gain = 1 - min(errors) / again.errors.sum()
    assert found.gain == pytest.approx(gain)
    assert found.share == pytest.approx(min(gain * model.ratio**2, 1.0))
    assert found.p == pytest.approx(null_p_value(max_gain_under_null(again, tried, 400, 0), gain))
    half = _best_force(model, None, 4.0, cfg, results)
    assert half is not None
    assert half.share == pytest.approx(gain * model.ratio**2 / 4)
    assert not half.form_error
    tiny = _best_force(model, None, 1e3, cfg, results)
    assert tiny is not None
    assert tiny.form_error
    assert _best_force(model, None, 1.0, replace(cfg, significance_level=1e-9), results) is None
    strict = replace(cfg, unknown_force=replace(cfg.unknown_force, min_gain=gain * 1.01))
    assert _best_force(model, None, 1.0, strict, results) is None
    assert _best_force(model, None, 1.0, cfg, lambda *_: []) is None
    rival = replace(model, pieces=tuple(replace(p, residual=0.9 * p.residual) for p in model.pieces))
    beaten = _best_force(model, rival, 1.0, cfg, results)
    assert beaten is not None
    less = 1 - with_interleaved_folds(rival).errors.sum() / again.errors.sum()
    assert beaten.instead == pytest.approx(less)
    assert beaten.share == pytest.approx(min((gain - less) * model.ratio**2, 1.0))
    assert beaten.p >= found.p
    perfect = replace(model, pieces=tuple(replace(p, residual=0.01 * p.residual) for p in model.pieces))
    assert _best_force(model, perfect, 1.0, cfg, results) is None
