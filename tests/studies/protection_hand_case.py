"""The case that docs/protection-level.md follows: ``python tests/studies/protection_hand_case.py`` prints its
figures."""

from __future__ import annotations

from itertools import combinations
from typing import Final

import numpy as np
from scipy.stats import norm

from railfix.integrity.protection import RiskBudget, protection_level
from railfix.integrity.protection.risk import set_sums
from railfix.integrity.raim import LinearModel

#: A risk whose parts are all asked for, and leave figures that can be followed.
HAND: Final = RiskBudget(
    risk_per_hour=1e-4,
    samples_per_hour=1.0,
    exclusion_share=0.0,
    false_alarm=0.01,
    satellite_prior={"G": 0.008, "E": 0.006, "C": 0.009},
    local_prior=0.002,
)
#: Direction cosines of the five satellites along the track.
COSINE: Final = (0.8, -0.8, 0.4, -0.4, 0.0)


def hand_model(error_m: tuple[float, ...]) -> LinearModel:
    """Five satellites of one clock, 1 m each, none sees the map error."""
    design = np.zeros((1, 5, 3))
    design[0, :, 0] = COSINE
    return LinearModel(
        root_weight=np.ones((1, 5)),
        clock=np.zeros(5, dtype=np.intp),
        clock_covariance_m2=np.full((1, 1, 1), 0.2),
        design=design,
        covariance_m2=np.diag([1.0 / 1.6, 0.09, 0.36])[None],
        prior=np.diag([0.0, 1.0 / 0.09, 1.0 / 0.36]),
        misfit=np.array([error_m]),
        freedom=np.array([3]),
        interest=1,
    )


def main() -> None:
    """Hypotheses with the same information together, then the level."""
    got = protection_level(hand_model((3.0, 0.0, 0.0, 0.0, 0.0)), list("GGGGG"), risk=HAND)
    k_alarm, level = float(got.k_false_alarm[0]), float(got.level_m[0])
    alike: dict[tuple[int, float], list[str]] = {}
    for size in (0, 1, 2):
        for out in combinations(range(5), size):
            rest = np.delete(np.array(COSINE), out)
            alike.setdefault((size, round(float(((rest - rest.mean()) ** 2).sum()), 9)), []).append(
                "+".join(str(i + 1) for i in out) or "none"
            )
    print("left out          sum of squares  sigma_J  sigma of x_J - x     T_J    prior  spent at the level")
    for (size, information), names in alike.items():
        sigma = information**-0.5
        apart = np.sqrt(max(sigma**2 - 0.625, 0.0))
        weight = len(names) * (2.0, 0.01, 1e-4)[size]
        spent = weight * norm.sf((level - k_alarm * apart) / sigma)
        print(
            f"{' '.join(names):20s}{information:12.4f}{sigma:9.3f}{apart:18.3f}{k_alarm * apart:8.3f}"
            f"{(1.0, 0.01, 1e-4)[size]:9.0e}{spent:12.2e}"
        )
    print(f"sigma {got.sigma_m[0]:.3f} m, unchecked {got.unchecked_risk[0]:.1e}")
    ks = (got.k_fault_free, got.k_one_fault, got.k_two_faults, got.k_false_alarm)
    print("K: no fault {:.3f}, one {:.3f}, two {:.3f}, false alarm {:.3f}".format(*(float(k[0]) for k in ks)))
    parts = (got.fault_free_m, got.one_fault_m, got.two_fault_m, got.level_m)
    print("no fault {:.2f} m, one {:.2f} m, two {:.2f} m, level {:.2f} m".format(*(float(p[0]) for p in parts)))
    print(f"3 m on satellite 1: |x_J - x|/T_J {got.separation[0]:.3f}")
    usual = RiskBudget()
    print(f"\ndefaults: {usual.risk_per_sample:.2e} a sample, K {usual.sample_k:.2f}")
    for n in (10, 20, 30, 37):
        prior = usual.prior(["G"] * min(n, 10) + ["E"] * max(n - 10, 0))[None]
        three = set_sums(prior, 3)[0, 3] / usual.risk_per_sample
        print(f"{n} satellites, ten of them GPS: {three:.3f} of it unchecked")


if __name__ == "__main__":
    main()
