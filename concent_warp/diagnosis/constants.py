"""Constants of the simulator that a diagnosis uses besides effects: constraints that hold, and a shorter time step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from concent_warp.scene.holding import Holding


@dataclass(frozen=True)
class HoldingConstraint:
    """Constraints that hold, by constants that the MJCF leaves at their defaults, before any effect."""

    where: Holding
    """Which ones."""
    settings: Mapping[str, str]
    """The constants as attributes of the MJCF."""
    gain: float
    """Share of the held-out error that they remove [-]."""
    low: float
    """Lower end of the 95 % interval of the gain."""
    high: float
    """Upper end."""
    beside: str = ""
    """Effect that was fitted with and without them, and is not part of the gain; empty for none."""

    @property
    def sentence(self) -> str:
        """A sentence on the constraints."""
        values = " and ".join(f'{name}="{value}"' for name, value in self.settings.items())
        if self.where == "cones":
            what = f"contact friction depends on the direction, by the simulator's default: with {values} it does not"
        elif self.where in ("equalities", "limits"):
            which = "equality constraints" if self.where == "equalities" else "limits of joints"
            what = f"{which} give way to a load, by default constants of the simulator: with {values} they hold"
        else:
            what = f"dry friction in {self.where} creeps, by default constants of the simulator: with {values} it holds"
        fall = f"{100 * self.gain:.0f} % [{100 * self.low:.0f}, {100 * self.high:.0f}]"
        fall += f", {self.beside} fitted in both" if self.beside else ""
        return f"The model's {what}, and the held-out error falls by {fall}; the diagnosis uses it."

    def to_json(self) -> dict[str, Any]:
        """Return it in plain types."""
        gain = {"value": self.gain, "interval": [self.low, self.high]}
        return {"where": self.where, "settings": dict(self.settings), "gain": gain, "beside": self.beside}


@dataclass(frozen=True)
class FinerTimeStep:
    """A shorter time step with which the model explains more, before any effect, or one for impacts."""

    given: float
    """Time step of the model as given [s]."""
    used: float
    """Time step of the diagnosis, and of the model that it returns [s]."""
    change: float
    """By how much it changes the predictions: root mean square over the noise, initial states fitted [-]."""
    gain: float
    """Share of the held-out error that it removes [-]."""
    low: float
    """Lower end of the 95 % interval of the gain."""
    high: float
    """Upper end."""
    too_long: bool = False
    """Whether the error that the used step still has may be all that is left, so that nothing can be said."""
    impacts: bool = False
    """Whether it is for impacts: `change` is their scatter by when between two steps they begin, `gain` its fall."""

    @property
    def error(self) -> float:
        """Error of the predictions that the used step still has over the noise [-]: in proportion to the step."""
        if self.impacts:
            return self.change * (1 - self.gain)
        return self.change / max(self.given / self.used - 1, 1e-12)

    @property
    def sentence(self) -> str:
        """A sentence on the time step."""
        if self.impacts:
            return (
                f"The model's time step of {1e3 * self.given:.3g} ms is too long for its impacts: when between two "
                f"steps they begin scatters its predictions by {_times(self.change)} x noise (rms), with "
                f"{1e3 * self.used:.3g} ms by {_times(self.error)} x. Constants of contacts are those of that step, "
                "which a saved model has."
            )
        said = (
            f"The model's time step of {1e3 * self.given:.3g} ms is too long for these data: with "
            f"{1e3 * self.used:.3g} ms its predictions change by {_times(self.change)} x noise, and the held-out error "
            f"falls by {100 * self.gain:.0f} % [{100 * self.low:.0f}, {100 * self.high:.0f}]; the diagnosis uses it."
        )
        if self.too_long:
            said += (
                f" Its own error is still about {_times(self.error)} x noise, which may be all that is left: shorten "
                'the step of the model further, or set integrator="RK4" where it has no contacts, and diagnose again.'
            )
        return said

    def to_json(self) -> dict[str, Any]:
        """Return the time step in plain types."""
        kept = {"error": self.error, "too_long": self.too_long, "impacts": self.impacts}
        gain = {"value": self.gain, "interval": [self.low, self.high]}
        return {"given": self.given, "used": self.used, "change": self.change, "gain": gain, **kept}


def _times(ratio: float) -> str:
    """Return a ratio to the noise in words of two digits, without an exponent."""
    return f"{ratio:.2g}" if ratio < 10 else f"{ratio:.0f}"
