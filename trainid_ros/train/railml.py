# SPDX-License-Identifier: Apache-2.0
"""Rolling stock and infrastructure of railML 2 and 3: t, m, km/h, N, per mille.

Elements and attributes are known by their names without namespace. A document type definition, and with it any entity,
is an error.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, NoReturn
from xml.etree import ElementTree

import numpy as np

from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import KM_H
from trainid_ros.interface.text import listed
from trainid_ros.train.draft import Draft, chosen
from trainid_ros.train.fields import shown
from trainid_ros.train.forces import G

_SPEEDS: Final = {'km/h': 1.0 / KM_H, 'm/s': 1.0}
_FORCES: Final = {'N': 1.0, 'kN': 1e3}
_PER_WEIGHT: Final = frozenset({'1', 'N/kN'})
"""Units of speed [m/s], force [N] and specific resistance [N/kN], for which railML 3 writes 1."""
_MAX: Final = 1e12
"""Largest number: what it may be is checked in the train file [any unit]."""
_FORMULA: Final = ('constantFactorA', 'speedDependentFactorB', 'squareSpeedDependentFactorC')
_DEFAULTS: Final = {'curve': 0.0, 'tunnel': 1.0}
"""Values of what may lack one: a straight [m] and a tunnel [1]."""
_INCIDENTAL: Final = frozenset({'id', 'name', 'code', 'description', 'register', 'entry', 'dir', 'sequence'})


@dataclass(frozen=True, slots=True)
class _Element:
    """An element, and all that was read of its document: pairs of element and attribute."""

    source: str
    xml: ElementTree.Element
    read: set[tuple[ElementTree.Element, str]]

    def each(self, *names: str) -> list[_Element]:
        """Return itself and the elements below it, of these names if any are given."""
        return [_Element(self.source, x, self.read) for x in self.xml.iter() if x.tag in names or not names]

    def text(self, *names: str) -> str:
        """Return the first of these attributes that is there, '' if none is."""
        name = next((name for name in names if name in self.xml.attrib), '')
        self.read.add((self.xml, name))
        return self.xml.attrib.get(name, '').strip()

    def number(self, *names: str, default: float = math.nan) -> float:
        """Return the first of these attributes that is there as a number, else the default."""
        text = self.text(*names)
        try:
            value = float(text) if text else default
        except ValueError:
            value = math.nan
        if text and not abs(value) <= _MAX:
            self.fail(f'{names[0]} = {shown(text)} must be a number')
        return value

    def anywhere(self, *names: str) -> float:
        """Return the first of these attributes in it and below it as a number, NaN if none is there."""
        return next((value for one in self.each() if math.isfinite(value := one.number(*names))), math.nan)

    def fail(self, problem: str) -> NoReturn:
        """Raise InputError naming file and element."""
        raise InputError(f'{self.source}: {self.xml.tag} {self.xml.get("id", "without id")}: {problem}')


def read_railml(text: str, source: str, formation: str, track: str, draft: Draft) -> None:
    """Add what a file states to a draft: a formation, or vehicle, and the line along one track.

    InputError, naming the element, if the file cannot be used.
    """
    if '<!DOCTYPE' in text:
        raise InputError(f'{source}: has a document type definition, which is not read')
    try:
        tree = ElementTree.fromstring(text.removeprefix('\ufeff'))
    except (ElementTree.ParseError, ValueError) as error:
        raise InputError(f'{source}: is not valid XML: {error}') from None
    for item in tree.iter():
        item.tag = item.tag.rpartition('}')[2]
        item.attrib = {name.rpartition('}')[2]: value for name, value in item.attrib.items()}
    root = _Element(source, tree, set())
    vehicles, tracks = (
        {name: one for one in root.each(tag) if (name := one.text('id'))} for tag in ('vehicle', 'track')
    )
    if not vehicles and not tracks:
        raise InputError(f'{source}: has neither vehicles nor tracks, as files of railML have')
    parts = _read_train(root, vehicles, formation, draft) if vehicles else []
    if tracks and (track or len(tracks) == 1 or not vehicles):
        parts += _read_line(root, tracks[chosen(track, list(tracks), source, '--track')], draft)
    elif tracks:
        draft.left_out.append(f'its {len(tracks)} tracks; choose one with --track')
    rest: dict[str, dict[str, None]] = {}
    for one in (one.xml for part in parts for one in part.each()):
        for name in one.attrib.keys() - _INCIDENTAL:
            if (one, name) not in root.read and not name.endswith('Ref'):
                rest.setdefault(one.tag, {})[f'{name}={one.attrib[name]}'] = None
    draft.left_out += [f'{tag} {", ".join(sorted(values)[:4])}' for tag, values in rest.items()]


def _read_train(root: _Element, vehicles: dict[str, _Element], name: str, draft: Draft) -> list[_Element]:
    formations = {one.text('id'): one for one in root.each('formation')} or vehicles
    train = formations[chosen(name, list(formations), root.source, '--formation')]
    order = [train] if formations is vehicles else []
    places = [one for one in train.each('trainOrder', 'vehicleRef') if one.text('vehicleRef')]
    for place in sorted(places, key=lambda one: one.number('orderNumber', default=0.0)):
        if (reference := place.text('vehicleRef')) not in vehicles:
            place.fail(f'vehicleRef = {reference} is no vehicle')
        order += [vehicles[reference]] * min(int(place.number('vehicleCount', default=1.0)), 1000)
    cars = [(1e3 * one.number('tareWeight', 'bruttoWeight'), one.number('length')) for one in order]
    sums = [round(math.fsum(x), 6) for x in zip(*cars, strict=True)] or [math.nan, math.nan]
    mass = 1e3 * train.number('tareWeight', 'bruttoWeight', 'weight', default=sums[0] / 1e3)
    speeds = [speed for one in order if math.isfinite(speed := one.number('speed'))]
    found = {
        'mass': mass, 'length': train.number('length', default=sums[1]),
        'max_speed': round(train.number('speed', default=min(speeds, default=math.nan)) / KM_H, 6),
    }  # fmt: skip
    factors = [one.anywhere('rotatingMassFactor', 'rotationMassFactor') - 1.0 for one in order]
    rotary = math.fsum(x * m for x, (m, _) in zip(factors, cars, strict=True))
    if {math.isfinite(factor) for factor in factors} == {True, False}:
        stated = (f'{x + 1.0:g} of {one.text("id")}' for one, x in zip(order, factors, strict=True) if math.isfinite(x))
        draft.left_out.append(f'rotatingMassFactor {listed([*dict.fromkeys(stated)], 4)}: other vehicles state none')
    found['rotary_mass'] = round(rotary / (sums[0] or math.nan), 6)
    draft.train |= {key: value for key, value in found.items() if math.isfinite(value)}
    draft.train['cars'] = max(len(cars), 1)
    if len(cars) > 1 and np.allclose(sums, (mass, found['length']), rtol=1e-3, atol=0.0):
        draft.train['cars'] = [dict(zip(('mass', 'length'), car, strict=True)) for car in cars]
    if math.isfinite(mass):
        draft.notes.append('mass: empty, if tareWeight is stated; enter that of the usual load')
        _read_resistance(train, mass, draft)
    _read_traction(train.each('trainEngine') or [x for one in order for x in one.each('engine')], draft)
    return [train, *order]


def _read_resistance(train: _Element, mass: float, draft: Draft) -> None:
    """Set a, b, c of a train of a mass [kg] from its formula, else from a table."""
    for formula in (one for one in train.each() if one.xml.attrib.keys() >= {*_FORMULA}):
        if formula.text('massDependent') != 'true':
            a, b, c = (formula.number(name) for name in _FORMULA)
            draft.notes.append(f'resistance: {a:g} + {b:g} v + {c:g} v^2 in N, with v in km/h')
            return draft.set_resistance((a, b * KM_H, c * KM_H**2), mass)
        draft.left_out.append('a formula per mass (massDependent), in a unit that is not stated')
    for owner in train.each('trainResistance', 'vehicleResistance', 'drivingResistance'):
        for x, y, unit in _tables(owner):
            scale = mass * G / 1e3 if unit in _PER_WEIGHT else _FORCES.get(unit, math.nan)
            if math.isfinite(scale) and len({*x.tolist()}) > 2:
                fit = np.polyfit(x, y * scale, 2)
                off = float(np.abs(np.polyval(fit, x) / scale - y).max() / np.abs(y).max())
                draft.notes.append(f'resistance: fitted to a table, at most {off:.1%} of its largest value off')
                return draft.set_resistance(fit[::-1].tolist(), mass)
            draft.left_out.append(f'a table of the resistance in {unit or "an unknown unit"}')
    return None


def _tables(owner: _Element) -> Iterator[tuple[np.ndarray[Any, Any], np.ndarray[Any, Any], str]]:
    """Yield speeds [m/s], values and their unit of each table over speed."""
    for table in owner.each('valueTable'):
        rows = np.array([(line.number('xValue'), line.anywhere('yValue')) for line in table.each('valueLine')])
        scale = _SPEEDS.get(table.text('xValueUnit') or 'km/h')
        if scale and rows.any() and np.isfinite(rows).all():
            yield rows[:, 0] * scale, rows[:, 1], table.text('yValueUnit')


def _read_traction(engines: Sequence[_Element], draft: Draft) -> None:
    forces, powers = ('maxTractiveEffort', 'maxTractEffort'), ('tractivePower', 'power')
    for name, attributes in (('max_traction_force', forces), ('max_traction_power', powers)):
        total = math.fsum(one.anywhere(*attributes) for one in engines)
        draft.train |= {name: total} if total > 0.0 else {}
    for x, y, unit in _tables(engines[0]) if len(engines) == 1 else ():
        if unit in _FORCES:
            draft.set_traction(list(zip(x.tolist(), (y * _FORCES[unit]).tolist(), strict=True)))


def _read_line(root: _Element, track: _Element, draft: Draft) -> list[_Element]:
    draft.notes.append(f'line: track {track.text("id")} in its own direction')
    if not root.each('netElement'):
        _read_track_2(track, draft)
        return [track]
    _read_track_3(root, track, draft)
    return [track, *root.each('geometry', 'functionalInfrastructure')]


def _read_track_2(track: _Element, draft: Draft) -> None:
    """Read values that hold from a position on."""
    begin, end = (x.number('pos') for tag in ('trackBegin', 'trackEnd') for x in track.each(tag)[:1] or [track])
    if not end > begin:
        track.fail('the positions (pos) of its trackBegin and trackEnd must rise')
    draft.extent = begin, end
    for kind, tag, name, scale in (
        ('gradient', 'gradientChange', 'slope', 1.0), ('curve', 'radiusChange', 'radius', 1.0),
        ('speed_limit', 'speedChange', 'vMax', 1.0 / KM_H),
    ):  # fmt: skip
        those = [one for one in track.each(tag) if one.text('dir') != 'down' and 'profileRef' not in one.xml.attrib]
        default = _DEFAULTS.get(kind, math.nan)
        rows = sorted((one.number('pos'), one.number(name, default=default) * scale) for one in those)
        for (start, value), (until, _) in zip(rows, [*rows[1:], (end, 0.0)], strict=True):
            draft.add(kind, start, until, value)
    for one in track.each('tunnel'):
        draft.add('tunnel', one.number('pos'), one.number('pos') + one.number('length'), 1.0)
    stops = [one for one in track.each('stopPost') if one.text('dir') != 'down'] or track.each('crossSection')
    draft.stops = [one.number('pos') for one in stops]


class _Place(NamedTuple):
    """Where a net element lies along the track."""

    start: float  # Position of the end that comes first [m]
    length: float  # [m]
    is_kept: bool  # False if the track runs from its end to its start

    def at(self, share: float) -> float:
        """Return the position [m], to the micrometre, of a share [1] of the net element from its own start."""
        return round(self.start + self.length * (share if self.is_kept else 1.0 - share), 6)


def _read_track_3(root: _Element, track: _Element, draft: Draft) -> None:
    """Read values of sections, by their places on the net elements of the track."""
    places, at = dict[str, _Place](), track.anywhere('measure')
    start = at = at if math.isfinite(at) else 0.0
    lengths, those = _lengths(root, track), [one for one in track.each() if one.text('netElementRef')]
    for one in sorted(those, key=lambda one: one.number('sequence', default=0.0)):
        if (net := one.text('netElementRef')) not in places:
            places[net] = _Place(at, lengths.get(net, math.nan), is_kept=_keeps(one))
            at += places[net].length
    if not math.isfinite(at):
        track.fail(f'one of its netElements {", ".join(places)} has no length')
    draft.extent = start, at
    for kind, tag, name, scale in (
        ('gradient', 'gradientCurve', 'gradient', 1.0), ('curve', 'horizontalCurve', 'radius', 1.0),
        ('speed_limit', 'speedSection', 'maxSpeed', 1.0 / KM_H), ('tunnel', 'overCrossing', '', 1.0),
    ):  # fmt: skip
        for one in root.each(tag):
            ends, (is_kept, is_along) = _ends(one, places), _directions(one, places)
            ways = {x.text('applicationDirection') for x in one.each('linearLocation')}
            against = {'reverse' if is_kept else 'normal'}  # Directions are those of the net element
            if ends and ways != against and (name or one.text('constructionType') == 'tunnel'):
                factor = -scale if kind == 'gradient' and not is_along else scale
                value = one.number(name, default=_DEFAULTS.get(kind, math.nan))
                draft.add(kind, min(ends), max(ends), value * factor)
    draft.stops = [x for one in root.each('stoppingPlace') for x in _ends(one, places)[:1]]


def _lengths(root: _Element, track: _Element) -> dict[str, float]:
    """Return the lengths of net elements [m]; one of the track without its own has what the others leave of it."""
    lengths = {one.text('id'): one.number('length') for one in root.each('netElement')}
    nets = {name for one in track.each() if (name := one.text('netElementRef'))}
    lacking = [net for net in nets if not math.isfinite(lengths.get(net, math.nan))]
    if len(lacking) == 1 and (total := track.each('length')[:1]):
        rest = total[0].number('value') - math.fsum(lengths[net] for net in nets if net != lacking[0])
        lengths[lacking[0]] = rest if rest > 0.0 else math.nan
    return lengths


def _keeps(one: _Element) -> bool:
    """Return False if something runs against its net element."""
    return one.text('keepsOrientation') not in {'false', '0'}


def _directions(element: _Element, places: dict[str, _Place]) -> tuple[bool, bool]:
    """Return whether the net element of an element, and the element itself, have the direction of the track."""
    those = (one for one in element.each('associatedNetElement') if one.text('netElementRef') in places)
    kept = ((places[one.text('netElementRef')].is_kept, _keeps(one)) for one in those)
    return next(((of_net, of_net == own) for of_net, own in kept), (True, True))


def _ends(element: _Element, places: dict[str, _Place]) -> list[float]:
    """Return the positions of an element [m] by the places of net elements."""
    found: list[float] = []
    for one in element.each('associatedNetElement', 'spotLocation'):
        if place := places.get(one.text('netElementRef')):
            shares = [one.number(f'intrinsicCoord{end}') for end in ('', 'Begin', 'End')]
            measures = [x.number('measure') for x in one.each() if 'measure' in x.xml.attrib]
            found += measures or [place.at(share) for share in shares if math.isfinite(share)]
    return found
