"""Which configurations a search may choose from."""

from __future__ import annotations

import ast
import itertools
import math
import operator
import tomllib
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from vtfs.configurations import Configuration, ConflictError, configuration
from vtfs.input_error import InputError
from vtfs.parameters import ONLY_WITH, PARAMETERS, TECHNIQUES, Value
from vtfs.technique_names import SHADOW_NAMES

LARGEST_SPACE = 100_000
"""More combinations than this are refused: counting them all would take hours."""


_WHAT = ("blending",)
"""Parameters that say what is drawn, not how."""


@dataclass(frozen=True)
class Space:
    """Every combination of `values` that keeps the `constraints`, for each technique.

    - `values`: for each technique, the values of some of its parameters; the others stay at their default.
      What goes with one value of another parameter only (`ONLY_WITH`) varies beside that value alone.
    - `constraints`: expressions such as `"tile_px * depth_slices <= 4096"`. One that names a parameter which
      a technique does not have does not apply to that technique.

    **Raises:** `InputError` where it is first enumerated, for a constraint that is no comparison of numbers and
    parameters, for values that never have an effect, for more than `LARGEST_SPACE` combinations, and for none.
    """

    techniques: tuple[str, ...]
    values: Mapping[str, Mapping[str, tuple[Value, ...]]]
    constraints: tuple[str, ...] = ()

    def configurations(self) -> tuple[Configuration, ...]:
        """All of them, in the order of `techniques` and then of the values; none twice."""
        return self._configurations

    def __len__(self) -> int:
        return len(self._configurations)

    def __contains__(self, candidate: object) -> bool:
        return candidate in self._members

    def default(self, technique: str) -> Configuration:
        """A technique's default, but drawing what the space says: one kind of shadow is no other's default."""
        given = self.values.get(technique, {})
        return configuration(technique, {name: given[name][0] for name in _WHAT if len(given.get(name, ())) == 1})

    def limited_to(self, techniques: Iterable[str]) -> Space:
        """The same space with some of its techniques."""
        kept = set(techniques)
        return Space(tuple(name for name in self.techniques if name in kept), self.values, self.constraints)

    @cached_property
    def _members(self) -> frozenset[Configuration]:
        return frozenset(self._configurations)

    @cached_property
    def _configurations(self) -> tuple[Configuration, ...]:
        size = sum(math.prod(len(values) for values in self.values.get(name, {}).values()) for name in self.techniques)
        if size > LARGEST_SPACE:
            raise InputError(f"`parameters`: {size:,} combinations; give values for at most {LARGEST_SPACE:,}.")
        for name in self.techniques:
            _refuse_without_effect(self.values.get(name, {}))
        rules = [_Constraint.parse(index, text) for index, text in enumerate(self.constraints)]
        found = [
            candidate
            for technique in self.techniques
            for candidate in _combinations(technique, self.values.get(technique, {}))
            if all(rule.allows(candidate) for rule in rules)
        ]
        if not found:
            raise InputError("`constraints`: no combination of the parameters keeps them all; relax one of them.")
        return tuple(dict.fromkeys(found))


def default_space(techniques: Iterable[str], n_samples: int) -> Space:
    """What is searched unless the user says otherwise: settings that change the speed and not the image.

    Small on purpose: each branching and batch compiles programs of its own, each grid is counted.

    **Arguments:**

    - `n_samples`: view samples of a frame. A batch that holds them all is the same as `batch = 0`.
    """
    lights: dict[str, tuple[Value, ...]] = {
        "tile_px": (8, 16, 32, 64),
        "depth_slices": (0, 16, 32, 64),
        "branching": (8, 32),
        "batch": (0, *(size for size in (16384, 65536) if size < n_samples)),
    }
    # A tile size of shadows compiles too. With 8 children all were the fastest, or nearly, on every device.
    shadows: dict[str, tuple[Value, ...]] = {"tile_px": (4, 8, 16), "depth_slices": (0, 32), "branching": (8, 32)}
    names = tuple(techniques)
    of_technique = {name: shadows if name in SHADOW_NAMES else lights for name in names}
    values = {name: {k: v for k, v in own.items() if k in TECHNIQUES[name]} for name, own in of_technique.items()}
    return Space(names, values)


def accuracy_values() -> tuple[dict[str, Value], ...]:
    """Settings that trade accuracy for speed, the most telling first.

    They are tried at the best exact configuration, for the chart of speed against error.
    """
    return (
        {"front_faces": "culled"},
        {"stencil": "wrap"},
        {"light_cutoff": 0.01},
        {"gbuffer": "float16"},
        {"approximate": 0.01},
        {"light_cutoff": 0.1},
        {"gbuffer": "bfloat16"},
        {"approximate": 0.1},
    )


def load_space(path: Path | str, techniques: Iterable[str]) -> Space:
    """A space from TOML: `[parameters]` with `tile_px = [8, 16, 32]`, ..., and `constraints = ["..."]`.

    Parameters that are not listed stay at their default. What a technique does not have is ignored for it.

    **Raises:** `InputError` that names the file, the field, the value and what would be right.
    """
    path = Path(path)
    try:
        return _parsed(_read_toml(path), tuple(techniques))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _read_toml(path: Path) -> dict[str, object]:
    try:
        return tomllib.loads(path.read_text("utf-8"))
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror or error}); give a TOML file.") from error
    except (ValueError, RecursionError) as error:  # UnicodeDecodeError and TOMLDecodeError are ValueErrors
        reason = " ".join(str(error).split()) or "nested too deeply"
        raise InputError(f"is not TOML ({reason}); write `[parameters]` and `tile_px = [8, 16, 32]`.") from error


def _parsed(content: Mapping[str, object], techniques: tuple[str, ...]) -> Space:
    for name in content:
        if name not in ("parameters", "constraints"):
            raise InputError(f"`{name}`: unknown; a space has `parameters` and `constraints`.")
    parameters = content.get("parameters")
    if not isinstance(parameters, dict) or not parameters:
        raise InputError("`[parameters]`: missing or empty; write for instance `tile_px = [8, 16, 32]` below it.")
    for technique in techniques:
        configuration(technique)  # refuses an unknown one by name
    values = {name: _parameter_values(name, given, techniques) for name, given in parameters.items()}

    constraints = content.get("constraints", [])
    if not isinstance(constraints, list) or not all(isinstance(text, str) for text in constraints):
        raise InputError(f'`constraints` = {constraints!r}: must be a list of texts, as `["tile_px <= 64"]`.')
    space = _space(techniques, values, tuple(constraints))
    space.configurations()  # refuses bad constraints, too many and none here, where the file is known
    return space


def _parameter_values(name: str, given: object, techniques: tuple[str, ...]) -> tuple[Value, ...]:
    if name not in PARAMETERS:
        raise InputError(f"`parameters.{name}`: unknown; choose from {', '.join(PARAMETERS)}.")
    if not any(name in TECHNIQUES[technique] for technique in techniques):
        offered = dict.fromkeys(itertools.chain.from_iterable(TECHNIQUES[technique] for technique in techniques))
        raise InputError(
            f"`parameters.{name}`: {', '.join(techniques)} does not have it; choose from {', '.join(offered)}."
        )
    if not isinstance(given, list) or not given:
        raise InputError(f"`parameters.{name}` = {given!r}: must be a list of values, each {PARAMETERS[name].allowed}.")
    return tuple(dict.fromkeys(PARAMETERS[name].parse(value) for value in given))


def _space(techniques: tuple[str, ...], values: Mapping[str, tuple[Value, ...]], constraints: tuple[str, ...]) -> Space:
    of_technique = {
        technique: {name: values[name] for name in TECHNIQUES[technique] if name in values} for technique in techniques
    }
    return Space(techniques, of_technique, constraints)


def _refuse_without_effect(values: Mapping[str, tuple[Value, ...]]) -> None:
    for name, (other, needed) in ONLY_WITH.items():
        given = values.get(name, ())
        if needed not in values.get(other, ()) and any(value != PARAMETERS[name].default for value in given):
            raise InputError(
                f"`parameters.{name}` = {list(given)}: has no effect without {other}={needed}; list {needed} in "
                f"`parameters.{other}`, or leave {name} out."
            )


def _combinations(technique: str, values: Mapping[str, tuple[Value, ...]]) -> Iterable[Configuration]:
    for chosen in itertools.product(*values.values()):
        params = dict(zip(values, chosen, strict=True))
        for name, (other, needed) in ONLY_WITH.items():
            if params.get(other) != needed:
                params.pop(name, None)  # one candidate, whatever its value
        try:
            yield configuration(technique, params)
        except ConflictError:  # such as cubic cells of linear slices: no candidate
            continue


_ARITHMETIC = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv,
    ast.Mod: operator.mod,
    ast.Pow: operator.pow,
}
_EQUALITY = {ast.Eq: operator.eq, ast.NotEq: operator.ne}
_COMPARISON = {**_EQUALITY, ast.Lt: operator.lt, ast.LtE: operator.le, ast.Gt: operator.gt, ast.GtE: operator.ge}
_SIGN = {ast.USub: operator.neg, ast.UAdd: operator.pos}
_LONGEST_CONSTRAINT = 200  # also bounds how deep it nests; there can be several
_LARGEST_EXPONENT, _LARGEST_BASE = 16, 1e9


@dataclass(frozen=True)
class _Constraint:
    """One constraint, checked when it is read: only what is listed above can be in the tree."""

    where: str
    root: ast.expr
    names: frozenset[str]

    @classmethod
    def parse(cls, index: int, text: str) -> _Constraint:
        where = f"`constraints[{index}]` = {text!r}"
        if len(text) > _LONGEST_CONSTRAINT:
            raise InputError(f"`constraints[{index}]`: {len(text)} characters; at most {_LONGEST_CONSTRAINT}.")
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")  # what Python only warns of, as `1or 2`, is refused here
                root = ast.parse(text.strip(), mode="eval").body
        except (SyntaxError, ValueError, RecursionError, MemoryError, Warning) as error:
            raise InputError(f"{where}: not an expression; write for instance `tile_px <= 64`.") from error
        if _kind(root, where) != "truth":
            raise InputError(f"{where}: compares nothing; write for instance `tile_px <= 64`.")
        return cls(where, root, frozenset(node.id for node in ast.walk(root) if isinstance(node, ast.Name)))

    def allows(self, candidate: Configuration) -> bool:
        """Does the configuration keep it, or have no part in it?"""
        params = candidate.params
        if not self.names <= params.keys():
            return True
        try:
            return bool(_evaluate(self.root, params))
        except (ArithmeticError, ValueError) as error:
            at = ", ".join(f"{name} = {params[name]!r}" for name in sorted(self.names))
            raise InputError(
                f"{self.where}: {error}, at {at}; exclude that first, as in `depth_slices == 0 or ...`."
            ) from error


def _kind(node: ast.expr, where: str) -> str:
    """`number`, `text` or `truth`: what the node evaluates to. Refuses everything that is not a plain comparison."""
    match node:
        case ast.Constant(value=value) if isinstance(value, str):
            return "text"
        case ast.Constant(value=value) if isinstance(value, int | float) and not isinstance(value, bool):
            return "number"
        case ast.Name(id=name):
            if name not in PARAMETERS:
                raise InputError(f"{where}: `{name}` is unknown; choose from {', '.join(PARAMETERS)}.")
            return "text" if isinstance(PARAMETERS[name].default, str) else "number"
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _ARITHMETIC:
            _expect("number", (left, right), where)
            return "number"
        case ast.UnaryOp(op=op, operand=operand) if type(op) in _SIGN:
            _expect("number", (operand,), where)
            return "number"
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            _expect("truth", (operand,), where)
            return "truth"
        case ast.BoolOp(values=operands):
            _expect("truth", operands, where)
            return "truth"
        case ast.Compare(left=left, ops=ops, comparators=others) if all(type(op) in _COMPARISON for op in ops):
            is_equality = all(type(op) in _EQUALITY for op in ops)
            kind = _kind(left, where)
            _expect("text" if kind == "text" and is_equality else "number", (left, *others), where)
            return "truth"
    raise InputError(
        f"{where}: `{ast.unparse(node)}` is not allowed; numbers, parameters, + - * / // % **, comparisons, "
        "and, or, not are."
    )


def _expect(kind: str, nodes: Iterable[ast.expr], where: str) -> None:
    for node in nodes:
        if _kind(node, where) != kind:
            raise InputError(
                f"{where}: `{ast.unparse(node)}` is not a {kind}; texts can only be compared with == and !=."
            )


def _evaluate(node: ast.expr, params: Mapping[str, Value]):
    match node:
        case ast.Constant(value=value):
            return value
        case ast.Name(id=name):
            return params[name]
        case ast.BinOp(left=left, op=op, right=right):
            a, b = _evaluate(left, params), _evaluate(right, params)
            too_large = isinstance(op, ast.Pow) and (abs(b) > _LARGEST_EXPONENT or abs(a) > _LARGEST_BASE)
            if too_large or (isinstance(op, ast.Pow) and a < 0 and b != int(b)):
                raise ValueError(f"`{ast.unparse(node)}` is out of bounds")
            return _ARITHMETIC[type(op)](a, b)
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            return not _evaluate(operand, params)
        case ast.UnaryOp(op=op, operand=operand):
            return _SIGN[type(op)](_evaluate(operand, params))
        case ast.BoolOp(op=op, values=operands):
            outcomes = (_evaluate(operand, params) for operand in operands)
            return all(outcomes) if isinstance(op, ast.And) else any(outcomes)
        case ast.Compare(left=left, ops=ops, comparators=others):
            sides = [_evaluate(side, params) for side in (left, *others)]
            return all(_COMPARISON[type(op)](a, b) for op, (a, b) in zip(ops, itertools.pairwise(sides), strict=True))
    raise AssertionError(f"`_kind` let {ast.dump(node)} through")
