# SPDX-License-Identifier: Apache-2.0
"""A headless Chromium for tests: what a page logs and fetches, and the picture that a person would see."""

from __future__ import annotations

import base64
import io
import json
import os
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread
from numpy.typing import NDArray

from test.hang import HANG_S

PROGRAMS = ('chromium', 'chromium-browser', 'google-chrome')
WIDTH, HEIGHT = 1200, 900
# Nothing outside this machine is found, so that a page that needs it fails.
OPTIONS = (
    '--headless=new',
    '--no-sandbox',
    '--disable-background-networking',
    '--disable-component-update',
    '--no-first-run',
    '--use-gl=angle',
    '--use-angle=swiftshader',
    '--enable-unsafe-swiftshader',
    '--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1, EXCLUDE localhost',
    '--remote-debugging-pipe',
    f'--window-size={WIDTH},{HEIGHT}',
)


class Chromium:
    """A browser that is spoken to over two pipes, in JSON messages that end with a zero byte."""

    def __init__(self, program: str, profile: Path) -> None:
        commands, self._commands = os.pipe()
        self._answers, answers = os.pipe()
        # Chromium reads from descriptor 3 and writes to 4.
        moved = f'exec {program} "$@" 3<&{commands} 4>&{answers}'
        self._process = subprocess.Popen(
            ['bash', '-c', moved, 'bash', *OPTIONS, f'--user-data-dir={profile}', 'about:blank'],
            pass_fds=(commands, answers),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(commands)
        os.close(answers)
        self._received = b''
        self._number = 0
        self._session: str | None = None
        self.events: list[dict[str, Any]] = []
        pages = self.call('Target.getTargets')['targetInfos']
        page = next(item['targetId'] for item in pages if item['type'] == 'page')
        self._session = self.call('Target.attachToTarget', targetId=page, flatten=True)['sessionId']
        for domain in ('Page', 'Runtime', 'Log', 'Network'):
            self.call(f'{domain}.enable')

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the DevTools protocol and return its result."""
        self._number += 1
        message: dict[str, Any] = {'id': self._number, 'method': method, 'params': parameters}
        if self._session is not None:
            message['sessionId'] = self._session
        os.write(self._commands, json.dumps(message).encode() + b'\0')
        while True:
            answer = self._receive()
            if answer.get('id') == self._number:
                assert 'error' not in answer, f'{method}: {answer}'
                result: dict[str, Any] = answer['result']
                return result
            self.events.append(answer)

    def _receive(self) -> dict[str, Any]:
        while b'\0' not in self._received:
            data = os.read(self._answers, 1 << 20)
            assert data, 'Chromium has ended'
            self._received += data
        text, _, self._received = self._received.partition(b'\0')
        message: dict[str, Any] = json.loads(text)
        return message

    def open(self, url: str) -> None:
        """Load a page and wait until it is complete."""
        self.events.clear()
        self.call('Page.navigate', url=url)
        end = time.monotonic() + HANG_S
        while self.evaluate('document.readyState') != 'complete' or self.evaluate('location.href') == 'about:blank':
            assert time.monotonic() < end, f'{url} does not load'
            time.sleep(0.02)

    def evaluate(self, expression: str) -> Any:
        """Return the value of a JavaScript expression."""
        return self.call('Runtime.evaluate', expression=expression, returnByValue=True)['result'].get('value')

    def errors(self) -> list[str]:
        """Return errors and warnings that the page logged, and its exceptions."""
        found = []
        for event in self.events:
            values = event.get('params', {})
            if event['method'] == 'Runtime.exceptionThrown':
                found.append(str(values['exceptionDetails']))
            elif event['method'] == 'Runtime.consoleAPICalled' and values['type'] in {'error', 'warning', 'assert'}:
                found.append(str(values['args']))
            elif event['method'] == 'Log.entryAdded' and values['entry']['level'] in {'error', 'warning'}:
                found.append(values['entry']['text'])
        return found

    def requests(self) -> list[str]:
        """Return the addresses that the page fetched."""
        sent = (event for event in self.events if event['method'] == 'Network.requestWillBeSent')
        return [str(event['params']['request']['url']) for event in sent]

    def picture(self, *, whole: bool = False) -> NDArray[np.float64]:
        """Return what is seen, or the whole page, as red, green and blue from 0 to 1, shape (rows, columns, 3)."""
        options: dict[str, Any] = {}
        if whole:
            size = self.call('Page.getLayoutMetrics')['cssContentSize']
            options = {'captureBeyondViewport': True, 'clip': {**size, 'scale': 1}}
        data = self.call('Page.captureScreenshot', format='png', **options)['data']
        image: NDArray[np.float64] = np.asarray(imread(io.BytesIO(base64.b64decode(data))), dtype=np.float64)
        return image[:, :, :3]

    def boxes(self, selector: str) -> list[tuple[int, int, int, int]]:
        """Return left, top, right and bottom of the elements that a CSS selector finds, in pixels of the whole page."""
        box = 'const b = e.getBoundingClientRect(), x = scrollX, y = scrollY'
        edges = '[b.left + x, b.top + y, b.right + x, b.bottom + y].map(Math.round)'
        found = self.evaluate(f'[...document.querySelectorAll({selector!r})].map(e => {{{box}; return {edges}}})')
        return [tuple(edges) for edges in found]

    def close(self) -> None:
        """End the browser."""
        self._process.kill()
        self._process.wait()
        os.close(self._commands)
        os.close(self._answers)


def find_chromium() -> str:
    """Return the program; skip the test if there is none."""
    found = next((path for name in PROGRAMS if (path := shutil.which(name))), None)
    if found is None:
        pytest.skip(f'none of {", ".join(PROGRAMS)} is installed')
    return found


def ink(picture: NDArray[np.float64]) -> float:
    """Return the share of the pixels that differ from the most frequent colour."""
    pixels = np.round(picture.reshape(-1, 3) * 255.0).astype(np.int64) @ np.array([65536, 256, 1])
    _, counts = np.unique(pixels, return_counts=True)
    return float(1.0 - counts.max() / pixels.size)
