# SPDX-License-Identifier: Apache-2.0
"""``trainid train import`` makes a train file of files of other systems, ``trainid train show`` shows one."""

from __future__ import annotations

import argparse
import zlib
from pathlib import Path
from textwrap import fill

from trainid_ros.cli.output import EXIT_NO_ANSWER, check_output, prepare_page, print_json, show
from trainid_ros.interface.errors import InputError
from trainid_ros.train.draft import FLAT, Draft, doubts, read_osrd
from trainid_ros.train.effects import check_effects
from trainid_ros.train.fields import parse_yaml, read_text
from trainid_ros.train.railml import read_railml
from trainid_ros.train.train_file import assumed_fields, parse_train_file

_HEAD = '# trainid train import'


def import_files(args: argparse.Namespace) -> int:
    """Read the files, write or print the train file with what it lacks as comments; 1 if it cannot be used so."""
    import yaml  # noqa: PLC0415 (slow to load)

    draft, out = Draft(), args.out
    for path in args.files:
        _read(path, args, draft)
    draft.drop_other_mass_std()
    draft.notes += draft.kept()
    sections, (needed, defaults) = draft.sections(), draft.missing()
    text = yaml.safe_dump(sections, sort_keys=False, default_flow_style=None, width=100, allow_unicode=True)
    check = []
    if not needed:
        train_file = parse_train_file(text, ', '.join(map(str, args.files)))  # Every value is in its range
        check_effects(train_file.effects)
        check = doubts(train_file)
    lists = {'check': check, 'read': draft.notes, 'left out': draft.left_out, 'not stated': defaults, 'missing': needed}
    lines = [fill(f'{name}: {"; ".join(found)}', 100, subsequent_indent='  ') for name, found in lists.items() if found]
    body = ''.join(f'# {line}\n' for line in '\n'.join(lines).splitlines()) + text
    page = f'{_HEAD} {_digest(body)}\n{body}'
    if out is not None:
        check_output(out, args.files, _HEAD)
        _check_unedited(out)
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(page, encoding='utf-8')
    if args.json:
        print_json({'out': out, 'train_file': sections, **{k.replace(' ', '_'): found for k, found in lists.items()}})
    else:
        step = 'enter what is missing, then ' if needed else ''
        show(page if out is None else '\n'.join([*lines, f'{out}: written']))
        show(f'# next: {step}trainid train show {out or "T.yaml"} --out page.html')
    return EXIT_NO_ANSWER if needed else 0


def _digest(text: str) -> str:
    return f'{zlib.crc32(text.encode()):08x}'


def _check_unedited(out: Path) -> None:
    """Raise InputError if a file that was imported has been edited since."""
    head, _, body = (read_text(out) if out.exists() else '').partition('\n')
    if head and head != f'{_HEAD} {_digest(body)}':
        raise InputError(f'{out}: edited since it was imported; choose another name, or delete it first')


def _read(path: Path, args: argparse.Namespace, draft: Draft) -> None:
    text = read_text(path)
    if path.suffix in {'.yaml', '.yml'}:
        top = parse_yaml(text, str(path))
        draft.merge(path.name, {name: top.section(name).data if name in FLAT else top.data[name] for name in top.data})
    elif path.suffix == '.json':
        read_osrd(text, str(path), args.track, draft)
    else:
        read_railml(text, str(path), args.formation, args.track, draft)


def show_file(args: argparse.Namespace) -> int:
    """Print a summary of a train file and write its page."""
    from trainid_ros.report.train_page import facts, train_page  # noqa: PLC0415 (help needs no plots)

    text, name = read_text(args.train), str(args.train)
    train_file, assumed = parse_train_file(text, name), assumed_fields(text, name)
    check_effects(train_file.effects)
    if args.out is not None:
        prepare_page(args.out).write_text(train_page(train_file, assumed, args.train.name), encoding='utf-8')
    if args.json:
        print_json({'out': args.out, 'train_file': train_file})
        return 0
    show('\n'.join(f'{name}: {text}' for name, text in facts(train_file, assumed)))
    if args.out is not None:
        show(f'{args.out}: written')
    return 0
