# SPDX-License-Identifier: Apache-2.0
"""Train files of railML 2 and 3, from small files in the shape of public ones."""

from __future__ import annotations

from typing import Any

import pytest
import yaml

from trainid_ros.interface.errors import InputError
from trainid_ros.train.draft import Draft
from trainid_ros.train.forces import G, davis
from trainid_ros.train.railml import read_railml
from trainid_ros.train.train_file import TrainFile, parse_train_file

KM_H = 1.0 / 3.6
STOCK_3 = """<?xml version='1.0' encoding='utf-8'?>
<rail3:railML xmlns:rail3="https://www.railml.org/schemas/3.3" version="3.3"><rail3:rollingstock>
<rail3:vehicles>
  <rail3:vehicle id="loco" speed="120" bruttoWeight="130" tareWeight="130" length="21.5" rotatingMassFactor="1.15">
    <rail3:engine><rail3:powerMode mode="diesel"><rail3:tractionData>
      <rail3:info maxTractiveEffort="270000" tractivePower="2420000"/>
    </rail3:tractionData></rail3:powerMode></rail3:engine>
    <rail3:drivingResistance><rail3:info airDragCoefficient="0.8" crossSectionArea="9.5" rollingResistance="1.5"/>
    </rail3:drivingResistance>
  </rail3:vehicle>
  <rail3:vehicle id="coach" speed="200" bruttoWeight="48" tareWeight="35" length="23" rotatingMassFactor="1.05">
    <rail3:drivingResistance><rail3:info airDragCoefficient="0.6" crossSectionArea="9" rollingResistance="1.2"/>
    </rail3:drivingResistance>
  </rail3:vehicle>
</rail3:vehicles>
<rail3:formations><rail3:formation id="train" tareWeight="200" bruttoWeight="226" length="67.5" speed="110">
  <rail3:trainOrder orderNumber="2" vehicleRef="coach"/>
  <rail3:trainOrder orderNumber="1" vehicleRef="loco"/>
  <rail3:trainOrder orderNumber="3" vehicleRef="coach"/>
  <rail3:trainBrakes meanDeceleration="0.9"/>
  <rail3:trainResistance tunnelFactor="1.8">{resistance}</rail3:trainResistance>
</rail3:formation></rail3:formations>
</rail3:rollingstock></rail3:railML>"""
FORMULA = """<rail3:daviesFormulaFactors constantFactorA="3800" speedDependentFactorB="45"
  squareSpeedDependentFactorC="2.5" massDependent="false"/>"""
STOCK_2 = """<railml xmlns="http://www.railml.org/schemas/2016" version="2.3"><rollingstock>
<vehicles><vehicle id="emu" length="75" tareWeight="150" speed="160"><engine>
  <propulsion id="p" power="1500000" maxTractEffort="150000" rotationMassFactor="1.1"/>
</engine></vehicle></vehicles>
<formations><formation id="double">
  <trainOrder><vehicleRef orderNumber="1" vehicleRef="emu" vehicleCount="2"/></trainOrder>
  <trainResistance><valueTable xValueName="speed" xValueUnit="km/h" yValueName="resistance" yValueUnit="{unit}">
  {rows}</valueTable></trainResistance>
</formation></formations></rollingstock></railml>"""
TRACK_2 = """<railml xmlns="http://www.railml.org/schemas/2013" version="2.2"><infrastructure><tracks>
<track id="t1"><trackTopology><trackBegin id="b" pos="100"/><trackEnd id="e" pos="3100"/></trackTopology>
<trackElements>
  <gradientChanges><gradientChange id="g1" pos="100" slope="0"/><gradientChange id="g2" pos="720" slope="-12.5"/>
  </gradientChanges>
  <radiusChanges><radiusChange id="r1" pos="400" radius="-400"/><radiusChange id="r2" pos="600" radius="0"/>
  </radiusChanges>
  <speedChanges><speedChange id="s1" pos="100" vMax="72" dir="up"/><speedChange id="s2" pos="900" vMax="36" dir="down"/>
    <speedChange id="s3" pos="1000" vMax="108" dir="up"/></speedChanges>
  <tunnels><tunnel id="u" pos="800" length="700"/></tunnels>
  <crossSections><crossSection id="c1" pos="150" ocpRef="o1"/><crossSection id="c2" pos="3000" ocpRef="o2"/>
  </crossSections>
  <bridges><bridge id="x" pos="2000" length="30"/></bridges>
</trackElements></track></tracks></infrastructure></railml>"""
PLACE = """<linearLocation applicationDirection="{way}"><associatedNetElement netElementRef="{net}"
  intrinsicCoordBegin="{begin}" intrinsicCoordEnd="{end}" keepsOrientation="true"/></linearLocation>"""
TRACK_3 = f"""<railML xmlns="https://www.railml.org/schemas/3.1" version="3.1"><infrastructure>
<topology><netElements><netElement id="n1" length="1000"/><netElement id="n2" length="500"/></netElements></topology>
<geometry>
  <horizontalCurves><horizontalCurve id="h" radius="400">{PLACE.format(way='both', net='n1', begin=0.3, end=0.5)}
  </horizontalCurve></horizontalCurves>
  <gradientCurves><gradientCurve id="g" gradient="-4">{PLACE.format(way='both', net='n2', begin=0.0, end=0.4)}
  </gradientCurve></gradientCurves></geometry>
<functionalInfrastructure>
  <tracks><track id="t"><linearLocation>
    <associatedNetElement netElementRef="n1"/><associatedNetElement netElementRef="n2"/>
  </linearLocation></track></tracks>
  <speeds><speedSection id="s1" maxSpeed="72">{PLACE.format(way='normal', net='n1', begin=0, end=1)}</speedSection>
    <speedSection id="s2" maxSpeed="36">{PLACE.format(way='reverse', net='n1', begin=0, end=1)}</speedSection></speeds>
  <overCrossings><overCrossing id="o" constructionType="tunnel">{PLACE.format(way='both', net='n1', begin=0.8, end=1)}
  </overCrossing></overCrossings>
  <stoppingPlaces><stoppingPlace id="p"><spotLocation netElementRef="n2" intrinsicCoord="0.5"/></stoppingPlace>
  </stoppingPlaces>
</functionalInfrastructure></infrastructure></railML>"""


def railml(text: str, formation: str = '', track: str = '') -> Draft:
    draft = Draft()
    read_railml(text, 'X.xml', formation, track, draft)
    return draft


def train_file(draft: Draft) -> TrainFile:
    return parse_train_file(yaml.safe_dump(draft.sections()), 'T.yaml')


def newtons(found: TrainFile, speed: float) -> float:
    return davis(found.resistance, speed) * found.train.mass * G / 1000.0


def test_the_length_of_a_formation_is_that_of_its_cars() -> None:
    text = STOCK_3.format(resistance=FORMULA).replace(' length="67.5"', '').replace('"23"', '"26.4"')
    text = text.replace('"21.5"', '"19"').replace('orderNumber="3"', 'orderNumber="3" vehicleCount="6"')
    assert railml(text).train['length'] == 203.8  # not 203.79999999999998, their sum


def test_a_formation_of_railml_3_has_the_cars_in_their_order() -> None:
    draft = railml(STOCK_3.format(resistance=FORMULA))
    train = train_file(draft).train
    assert train.consist == ((130e3, 21.5), (35e3, 23.0), (35e3, 23.0))
    assert (train.mass, train.length) == (200e3, 67.5)
    assert train.max_speed == pytest.approx(110.0 * KM_H, abs=1e-6)
    assert train.rotary_mass == pytest.approx((130.0 * 0.15 + 70.0 * 0.05) / 200.0)
    assert (train.max_traction_force, train.max_traction_power) == (270e3, 2.42e6)
    left = '; '.join(draft.left_out)
    for text in ('meanDeceleration=0.9', 'tunnelFactor=1.8', 'bruttoWeight=226', 'mode=diesel'):
        assert text in left


def test_a_factor_of_the_engine_alone_is_named() -> None:
    draft = railml(STOCK_3.replace(' rotatingMassFactor="1.05"', ''))
    assert 'rotary_mass' not in draft.train
    assert 'rotatingMassFactor 1.15 of loco: other vehicles state none' in draft.left_out


def test_its_formula_is_in_newtons_with_the_speed_in_km_h() -> None:
    draft = railml(STOCK_3.format(resistance=FORMULA))
    assert newtons(train_file(draft), 100.0 * KM_H) == pytest.approx(3800.0 + 45.0 * 100.0 + 2.5 * 1e4, rel=1e-5)
    assert any('v in km/h' in note for note in draft.notes)


def test_a_formula_per_mass_is_left_out_as_its_unit_is_not_known() -> None:
    text = STOCK_3.format(resistance=FORMULA.replace('"false"', '"true"')).replace(
        '<rail3:info air', '<rail3:other air'
    )
    draft = railml(text)
    assert draft.missing()[0] == ['resistance.a', 'resistance.b', 'resistance.c']
    assert any('massDependent' in line for line in draft.left_out)
    assert any('airDragCoefficient=0.8' in line for line in draft.left_out)


@pytest.mark.parametrize(
    ('unit', 'scale'), [('N', 1.0), ('kN', 1e-3), ('N/kN', 1.0 / (300.0 * G)), ('1', 1.0 / (300.0 * G))]
)
def test_a_table_of_railml_2_is_fitted_whatever_its_unit(unit: str, scale: float) -> None:
    line = '<valueLine xValue="{}"><values yValue="{}"/></valueLine>'
    rows = ''.join(line.format(v, (2000.0 + 30.0 * v + 4.0 * v * v) * scale) for v in range(0, 161, 20))
    found = train_file(railml(STOCK_2.format(unit=unit, rows=rows)))
    assert newtons(found, 90.0 * KM_H) == pytest.approx(2000.0 + 30.0 * 90.0 + 4.0 * 8100.0, rel=1e-4)
    assert found.train.consist == ((150e3, 75.0), (150e3, 75.0))
    assert found.train.max_traction_force == 300e3
    assert found.train.rotary_mass == pytest.approx(0.1)


def test_a_table_in_an_unknown_unit_is_left_out() -> None:
    draft = railml(STOCK_2.format(unit='daN/t', rows='<valueLine xValue="0"><values yValue="1"/></valueLine>' * 3))
    assert draft.missing()[0] == ['resistance.a', 'resistance.b', 'resistance.c']
    assert 'a table of the resistance in daN/t' in draft.left_out


def test_a_track_of_railml_2_keeps_its_positions() -> None:
    line = railml(TRACK_2).sections()['line']
    assert line == {
        'gradient': [[100.0, 0.0], [720.0, -12.5]],
        'curve': [[100.0, 0.0], [400.0, 400.0], [600.0, 0.0]],
        'speed_limit': [[100.0, pytest.approx(20.0)], [1000.0, pytest.approx(30.0)]],
        'tunnel': [[800.0, 1500.0]],
        'stops': [150.0, 3000.0],
    }


def test_a_track_of_railml_3_runs_over_its_net_elements() -> None:
    draft = railml(TRACK_3)
    draft.train['max_speed'] = 25.0
    assert draft.sections()['line'] == {
        'gradient': [[0.0, 0.0], [1000.0, -4.0], [1200.0, 0.0]],
        'curve': [[0.0, 0.0], [300.0, 400.0], [500.0, 0.0]],
        'speed_limit': [[0.0, pytest.approx(20.0)], [1000.0, 25.0]],
        'tunnel': [[800.0, 1000.0]],
        'stops': [1250.0],
    }


@pytest.mark.parametrize(
    ('text', 'attribute', 'place'),
    [
        (TRACK_2, ' slope="-12.5"', 'gradient from 720 to 3100 m'),
        (TRACK_2, ' vMax="108"', 'speed_limit from 1000 to 3100 m'),
        (TRACK_3, ' gradient="-4"', 'gradient from 1000 to 1200 m'),
    ],
    ids=['slope', 'vMax', 'gradient'],
)
def test_a_change_without_its_value_is_left_out(text: str, attribute: str, place: str) -> None:
    assert f'{place}, without a value' in railml(text.replace(attribute, '')).left_out
    assert not any('without a value' in line for line in railml(text).left_out)


def test_a_curve_without_radius_is_straight() -> None:
    draft = railml(TRACK_2.replace(' radius="0"', ''))
    assert draft.sections()['line'] == railml(TRACK_2).sections()['line']
    assert draft.left_out == railml(TRACK_2).left_out


N1, N2 = '<associatedNetElement netElementRef="n1"/>', '<associatedNetElement netElementRef="n2"/>'


def with_attribute(net: str, attribute: str) -> str:
    return net.replace('/>', f' {attribute}/>')


def line_of(text: str) -> dict[str, Any]:
    draft = railml(text)
    draft.train['max_speed'] = 25.0
    line: dict[str, Any] = draft.sections()['line']
    return line


def test_net_elements_are_in_their_stated_sequence() -> None:
    text = TRACK_3.replace(N1, with_attribute(N1, 'sequence="10"')).replace(N2, with_attribute(N2, 'sequence="9"'))
    line = line_of(text)
    assert line['gradient'] == [[0.0, -4.0], [200.0, 0.0]]
    assert line['curve'] == [[0.0, 0.0], [800.0, 400.0], [1000.0, 0.0]]
    assert line['stops'] == [250.0]


def test_a_net_element_that_is_run_backwards_is_mirrored() -> None:
    line = line_of(TRACK_3.replace(N2, with_attribute(N2, 'keepsOrientation="false"')))
    assert line['gradient'] == [[0.0, 0.0], [1300.0, 4.0]]
    back = line_of(TRACK_3.replace(N1, with_attribute(N1, 'keepsOrientation="false"')))
    assert back['curve'] == [[0.0, 0.0], [500.0, 400.0], [700.0, 0.0]]
    assert back['tunnel'] == [[0.0, 200.0]]
    assert back['speed_limit'] == [[0.0, pytest.approx(10.0)], [1000.0, 25.0]]
    assert back['gradient'] == [[0.0, 0.0], [1000.0, -4.0], [1200.0, 0.0]]


def test_a_gradient_against_its_net_element_changes_its_sign() -> None:
    own = PLACE.format(way='both', net='n2', begin=0.0, end=0.4)
    text = TRACK_3.replace(own, own.replace('"true"', '"false"'))
    assert line_of(text)['gradient'] == [[0.0, 0.0], [1000.0, 4.0], [1200.0, 0.0]]
    both = text.replace(N2, with_attribute(N2, 'keepsOrientation="false"'))
    assert line_of(both)['gradient'] == [[0.0, 0.0], [1300.0, -4.0]]


def test_a_net_element_without_length_has_what_is_left_of_the_track() -> None:
    text = TRACK_3.replace('</linearLocation></track>', '</linearLocation><length value="1600"/></track>')
    assert line_of(text.replace('length="1000"', ''))['stops'] == [1350.0]


@pytest.mark.parametrize(
    ('text', 'track', 'message'),
    [
        ('<railml', '', 'X.xml: is not valid XML: unclosed token'),
        ('<!DOCTYPE a [<!ENTITY b SYSTEM "f.txt">]><a>&b;</a>', '', 'X.xml: has a document type definition'),
        ('<a><b/></a>', '', 'X.xml: has neither vehicles nor tracks'),
        (TRACK_2.replace('"-12.5"', '"steep"'), '', "X.xml: gradientChange g2: slope = 'steep' must be a number"),
        (TRACK_2.replace('pos="3100"', 'pos="nan"'), '', "X.xml: trackEnd e: pos = 'nan' must be a number"),
        (TRACK_2.replace('pos="3100"', 'pos="0"'), '', 'X.xml: track t1: the positions'),
        (TRACK_2, 't2', "X.xml: has no 't2'; known: t1; choose one with --track"),
        (TRACK_3.replace('length="500"', ''), '', 'X.xml: track t: one of its netElements n1, n2 has no length'),
        (STOCK_3.replace('vehicleRef="loco"', 'vehicleRef="gone"'), '', 'X.xml: trainOrder without id: '),
    ],
    ids=range(9),
)  # fmt: skip
def test_what_cannot_be_read_is_named_with_file_and_element(text: str, track: str, message: str) -> None:
    with pytest.raises(InputError) as caught:
        railml(text, track=track)
    assert str(caught.value).startswith(message)
