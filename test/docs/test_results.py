# SPDX-License-Identifier: Apache-2.0
"""RESULTS.md: made from the full tables, short, of one revision where one run measures them, and quoted correctly."""

from __future__ import annotations

from importlib import import_module
from itertools import pairwise
from pathlib import Path

import pytest

from benchmarks.run import PARTS, main, missing_quotes, revisions, summary

ROOT = Path(__file__).resolve().parents[2]
NAMES = [*PARTS]
# Parts that take half of the time of the whole run, and change with nodes and readers rather than with estimators.
OF_PROCESSES = {'kills', 'soak', 'damage', 'faults_live', 'peers'}
# Parts that change with the check of the inputs, not with estimators of healthy drives; and with explain.
OF_FINDINGS = {'faults', 'healthy', 'integrity', 'slides'}
OF_EXPLAIN = {'commands', 'explain'}
OF_ESTIMATORS = {name for name, part in PARTS.items() if part.minutes} - OF_PROCESSES - OF_FINDINGS - OF_EXPLAIN
RESULTS = (ROOT / 'benchmarks' / 'RESULTS.md').read_text('utf-8')


def test_results_are_the_summary_of_the_full_tables() -> None:
    assert summary(ROOT / 'benchmarks' / 'results', NAMES) == RESULTS
    assert len(revisions(RESULTS)) == len([*(ROOT / 'benchmarks' / 'results').glob('*.md')])
    assert RESULTS.count('\n') <= 1500


@pytest.mark.parametrize(
    'names',
    [OF_PROCESSES, OF_FINDINGS, OF_EXPLAIN, OF_ESTIMATORS],
    ids=['processes', 'findings', 'explain', 'estimators'],
)
def test_parts_that_depend_on_the_same_sources_are_of_one_revision(names: set[str]) -> None:
    texts = [(ROOT / 'benchmarks' / 'results' / f'{name}.md').read_text('utf-8') for name in names]
    assert len({revision for text in texts for revision in revisions(text)}) == 1


@pytest.mark.parametrize(
    'path', [ROOT / 'README.md', *sorted((ROOT / 'docs').glob('*.md'))], ids=lambda path: path.name
)
def test_quoted_figures_are_in_the_results(path: Path) -> None:
    assert missing_quotes(path.read_text('utf-8'), RESULTS, ROOT / 'benchmarks' / 'results') == []


# Tables of evidence whose figures no part of the results holds, by their first cell.
NOT_IN_RESULTS = {
    ('status_evidence.md', 'estimate'): 'a replay of the bag with rounded speeds',
}


def test_all_other_tables_of_evidence_are_quoted() -> None:
    found = set()
    for path in (ROOT / 'docs').glob('*_evidence.md'):
        blocks = path.read_text('utf-8').split('\n\n')
        for before, block in pairwise(blocks):
            if block.startswith('|') and not before.startswith('<!-- quoted from '):
                found.add((path.name, block.split('|')[1].strip()))
    assert found == NOT_IN_RESULTS.keys()


def test_a_figure_that_is_not_in_its_part_is_found(tmp_path: Path) -> None:
    (tmp_path / 'one.md').write_text('| a | 2.94 | 1000 | .30 |\n', encoding='utf-8')
    results = '## one\n\n| a | 2.94 |\n\n## two\n\n| b | 7 |\n'
    document = '<!-- quoted from one -->\n2.9 and 7 on [page 5](8.md) of `9`\n\n8, which is not quoted\n'
    assert missing_quotes(document, results, tmp_path) == ['one: 7', 'one: 5']
    document = '<!-- quoted from results/one -->\n2.9, 1,000, 0.30 and 5\n'
    assert missing_quotes(document, results, tmp_path) == ['one: 5']


def test_a_run_without_time_measures_nothing_and_fails(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['--only', 'cost', 'rates', '--budget', '0', '--out', str(tmp_path / 'RESULTS.md')]) == 1
    assert 'not measured: cost, rates' in capsys.readouterr().err
    assert not (tmp_path / 'RESULTS.md').exists()


def test_the_whole_run_is_expected_to_take_at_most_90_minutes() -> None:
    assert sum(part.minutes for part in PARTS.values()) <= 90.0
    assert all(
        callable(getattr(import_module(module), name))
        for module, _, name in (
            part.measure.partition(':') for part in PARTS.values() if part.measure.startswith('benchmarks.scenario')
        )
    )
