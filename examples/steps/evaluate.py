"""Evaluate a policy: how often it succeeds in simulation and in Reality.

python examples/steps/evaluate.py [--policy shape_sorter] [--episodes 20]
"""

import tyro

import concent_warp as cw


def main(policy: str = "shape_sorter", episodes: int = 20) -> None:
    """Run a policy, one that comes with the package or a run folder, in both worlds."""
    loaded = cw.load_policy(policy)
    for world in ("simulation", "reality"):
        result = cw.evaluate(loaded, world=world, episodes=episodes)
        print(f"{world}: {100 * result.rate:.0f} % of {episodes}; {result.counts()}")


if __name__ == "__main__":
    tyro.cli(main)
