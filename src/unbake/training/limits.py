"""What a fit needs, before it is made: memory of its fields."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from ..config import FieldSettings, FitConfig, update
from ..errors import UserError
from ..fields import radiance
from ..fields.registry import Representation, representation
from ..fields.settings import SizedSettings
from ..memory import largest, require_memory, reserved_counts
from ..quantities import QUANTITIES
from ..transport.objective import has_radiance

#: Memory of a number that is learned: its value, its gradient and Adam's two moments, these anew in
#: a step, and all copied and put together for a checkpoint (measured: 62 to 70); and two snapshots
#: of value and moments, to which a fit that diverges goes back.
BYTES_A_NUMBER = 96
#: Where what is reserved counts as well: Dr.Jit 1.5 rounds arrays up to powers of two (measured: up
#: to 122 bytes a number), and crashes where it gets no memory; kernels and threads have a fixed
#: share (measured: 70 MB).
_RESERVED, _RESERVED_ALWAYS = 1.5, 150e6


@dataclass(frozen=True)
class _Field:
    """A field that a fit will make."""

    key: str  #: of its settings, dotted
    form: Representation
    settings: FieldSettings
    outputs: int
    extra: int = 0

    def bytes(self, materials: int) -> int:
        """Memory that it takes; 0 if its settings do not tell."""
        if not isinstance(self.settings, SizedSettings):
            return 0
        return BYTES_A_NUMBER * self.settings.numbers(self.outputs, self.extra, materials)

    @property
    def size(self) -> int:
        """The setting that decides how large it is."""
        value: Any = self.settings
        for key in (self.form.size or "").split("."):
            value = getattr(value, key)
        return value

    def resized(self, size: int) -> _Field | None:
        """The field in another size; None if it cannot have it."""
        table: Mapping[str, Any] | int = size
        for key in reversed((self.form.size or "").split(".")):
            table = {key: table}
        assert isinstance(table, Mapping)
        try:
            return replace(self, settings=update(self.settings, table))
        except UserError:
            return None


def require_room(config: FitConfig, materials: int) -> None:
    """Refuse fields that do not fit the memory, before any is made.

    Args:
        config: settings of the fit.
        materials: number of the scene's materials.

    Raises:
        UserError: they do not fit; it names the largest field, and the size that would fit.
    """
    fields = _fields(config)
    needs = {field.key: field.bytes(materials) for field in fields}
    guide = 0
    if has_radiance(config.chosen_method):
        guide = BYTES_A_NUMBER * config.guide.numbers()
    total = sum(needs.values()) + guide
    if not total:
        return
    told = "the fields of this fit, with gradients and Adam's moments, need"
    if guide >= max(needs.values(), default=0):
        lower = f"Lower guide.cells from {config.guide.cells}"
        require_memory(_reserved(total), told, lambda free: lower, "guide.cells")
        return
    worst = max(fields, key=lambda field: needs[field.key])
    others = total - needs[worst.key]

    def remedy(free: int) -> str:
        if worst.form.size is None:
            return f"Make the field of {worst.key} smaller"

        def fits(size: int) -> bool:
            resized = worst.resized(size)
            return resized is None or _reserved(others + resized.bytes(materials)) <= free

        most = largest(fits, worst.size)
        name = f"{worst.key}.{worst.form.size}"
        if most and worst.resized(most):
            return f"Lower {name} from {worst.size} to {most} or less"
        return f"Lower {name} and those of the other fields"

    require_memory(_reserved(total), told, remedy, worst.key)


def _reserved(need: float) -> float:
    """Bytes that are taken where so many are used."""
    return _RESERVED * need + _RESERVED_ALWAYS if reserved_counts() else need


def _fields(config: FitConfig) -> list[_Field]:
    found = []
    if config.learns_materials:
        form = representation(config.representation)
        for name, settings in config.material_settings.items():
            key = f"materials.{name}.{form.name}"
            found.append(_Field(key, form, settings, QUANTITIES[name].channels))
    if has_radiance(config.chosen_method):
        form, settings = representation(config.radiance_representation), config.radiance_settings
        key = f"radiance.{form.name}"
        found.append(_Field(key, form, settings, radiance.OUTPUTS, radiance.EXTRA))
    return found
