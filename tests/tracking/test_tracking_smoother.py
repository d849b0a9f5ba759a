"""Places from both directions: against a dense batch solution, by chunks, and on a ride with a gap."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from railfix.kernels.tracking import index as ix
from railfix.tracking import BackwardInformation, Step, TrackingLimits, TrackState, smooth_steps, track
from railfix.tracking.smoother import transition
from tracking_cases import Ride, bent_line, part, ride, without_epochs

LIMITS = TrackingLimits()


def _traced(case: Ride, state: TrackState | None = None) -> tuple[list[Step], TrackState]:
    trace: list[Step] = []
    _, after = track(case.epochs, case.line, state, trace=trace)
    return trace, after


def _dense(trace: list[Step]) -> tuple[np.ndarray, np.ndarray]:
    """Places and their sigmas from all epochs at once: joint covariance of all unknowns, one system."""
    width = trace[0].mean.shape[1]
    size = len(trace)
    joint = np.zeros((size, width, size, width))
    means, combined = [], []
    for t, step in enumerate(trace):
        assert step.trace is not None
        prior, combine, value, variance, restarted, _ = (array[0] for array in step.trace)
        combined.append((combine, np.diag(1.0 / variance), value / variance))
        innovation_free = _prediction(step)
        if t == 0:
            joint[0, :, 0] = prior
            means.append(innovation_free)
            continue
        move = transition(trace[t - 1].mean[0], step.dt, LIMITS)
        move[restarted] = 0.0
        joint[t, :, :t] = np.einsum("ij,jsk->isk", move, joint[t - 1, :, :t])
        joint[:t, :, t] = np.moveaxis(joint[t, :, :t], 0, -1)
        noise = prior - move @ trace[t - 1].covariance[0] @ move.T
        joint[t, :, t] = move @ joint[t - 1, :, t - 1] @ move.T + noise
        # What the filter added to the mean beside the transition: clocks near the epoch's.
        means.append(move @ (means[-1] - trace[t - 1].mean[0]) + innovation_free)
    whole = joint.reshape(size * width, size * width)
    counts = [len(combine) for combine, _, _ in combined]
    edges = np.concatenate([[0], np.cumsum(counts)])
    rows, weights, right = np.zeros((edges[-1], size * width)), np.zeros((edges[-1], edges[-1])), np.zeros(edges[-1])
    for t, (combine, weight, vector) in enumerate(combined):
        at = slice(edges[t], edges[t + 1])
        rows[at, t * width : (t + 1) * width] = combine
        weights[at, at] = weight
        # Measured against the filter's own prediction; here against the one without any measurement.
        prediction = _prediction(trace[t])
        right[at] = vector + weight @ combine @ (prediction - means[t])
    cross = whole @ rows.T
    system = np.eye(len(right)) + weights @ rows @ cross
    change = cross @ np.linalg.solve(system, right)
    after = whole - cross @ np.linalg.solve(system, weights @ cross.T)
    place = np.arange(size) * width + int(ix.ARC)
    arc = np.array([mean[ix.ARC] for mean in means]) + change[place]
    return arc, np.sqrt(after[place, place])


def _prediction(step: Step) -> np.ndarray:
    """Mean before the measurements."""
    assert step.trace is not None
    prior, row, value, variance, _, _ = (array[0] for array in step.trace)
    whitened = row / np.sqrt(variance)[:, None]
    system = np.eye(len(row)) + whitened @ prior @ whitened.T
    return np.asarray(step.mean[0] - prior @ whitened.T @ np.linalg.solve(system, value / np.sqrt(variance)))


@pytest.mark.requirement("E5")
def test_smoothed_places_are_those_of_one_dense_solution() -> None:
    case = ride(12, noise=1.0, seed=7)
    _, state = track(part(case.epochs, slice(0, 4)), case.line)
    later = Ride(part(case.epochs, slice(4, 12)), case.arc_m[4:], case.speed_mps[4:], case.trajectory)
    trace, _ = _traced(later, state)
    result, _ = smooth_steps(trace, state, None, LIMITS)
    arc, sigma = _dense(trace)
    np.testing.assert_allclose(result.arc_m, arc, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(result.sigma_m, sigma, rtol=0.0, atol=1e-9)


@pytest.mark.requirement("E5")
def test_a_larger_ionospheric_error_widens_the_sigma_as_in_the_filter() -> None:
    """At the last epoch, without later measurements, the sigma is the filter's; positions do not change."""
    case, found = ride(30, noise=1.0, seed=7), {}
    for scale in (1.0, 3.0):
        trace: list[Step] = []
        epochs = replace(case.epochs, tilt_scale=np.full(30, scale))
        filtered, _ = track(epochs, case.line, trace=trace)
        found[scale], _ = smooth_steps(trace, TrackState(), None, LIMITS)
        np.testing.assert_allclose(found[scale].sigma_m[-1], filtered.sigma_m[-1], rtol=1e-9)
    np.testing.assert_array_equal(found[1.0].arc_m, found[3.0].arc_m)
    assert (found[3.0].sigma_m > 1.5 * found[1.0].sigma_m).all()


@pytest.mark.requirement("E5")
def test_chunks_backward_give_what_the_whole_gives() -> None:
    case = ride(60, noise=1.0, seed=3)
    trace, _ = _traced(case)
    whole, _ = smooth_steps(trace, TrackState(), None, LIMITS)
    pieces, states, state = [], [TrackState()], None
    for cut in (slice(0, 7), slice(7, 40), slice(40, 60)):
        one = Ride(part(case.epochs, cut), case.arc_m[cut], case.speed_mps[cut], case.trajectory)
        trace, state = _traced(one, state)
        pieces.append(trace)
        states.append(state)
    later: BackwardInformation | None = None
    arcs = []
    for trace, before in zip(pieces[::-1], states[-2::-1], strict=True):
        result, later = smooth_steps(trace, before, later, LIMITS)
        arcs.append(result.arc_m)
    np.testing.assert_allclose(np.concatenate(arcs[::-1]), whole.arc_m, rtol=0.0, atol=1e-9)


@pytest.mark.requirement("E5")
def test_a_gap_is_bridged_from_both_ends_within_its_sigmas() -> None:
    ratios, inside, forward = [], [], []
    gap = np.zeros(150, dtype=bool)
    gap[70:85] = True
    for seed in range(6):
        case = ride(150, trajectory=bent_line(4000.0), noise=1.0, seed=seed)
        blank = without_epochs(case.epochs, gap)
        trace: list[Step] = []
        found, _ = track(blank, case.line, trace=trace)
        result, _ = smooth_steps(trace, TrackState(), None, LIMITS)
        error = np.abs(result.arc_m - case.arc_m)
        ratios.append(error / result.sigma_m)
        inside.append(error[gap])
        forward.append(np.abs(found.arc_m - case.arc_m)[gap])
    assert np.percentile(np.concatenate(inside), 95) < 0.5 * np.percentile(np.concatenate(forward), 95)
    assert np.percentile(np.concatenate(ratios), 95) < 2.5


@pytest.mark.requirement("E5")
def test_nothing_goes_back_beyond_a_beginning() -> None:
    case = ride(40, noise=1.0)
    trace, _ = _traced(case)
    whole, _ = smooth_steps(trace, TrackState(), None, LIMITS)
    first, _ = smooth_steps(trace[:20], TrackState(), None, LIMITS)
    assert not np.allclose(first.arc_m, whole.arc_m[:20], rtol=0.0, atol=1e-6)
    trace[20].parent = np.full_like(trace[20].parent, -1)
    broken, _ = smooth_steps(trace, TrackState(), None, LIMITS)
    np.testing.assert_array_equal(broken.arc_m[:20], first.arc_m)
