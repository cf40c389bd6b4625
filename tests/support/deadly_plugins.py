"""Plugins that do what a damaged file does to the process that reads it."""

from __future__ import annotations

import os
import signal
import time

import mitsuba as mi

from torchtransient.plugins import register

MODULE = "support.deadly_plugins"
NAMES = (("bsdf", "ends_the_process"), ("bsdf", "never_answers"))


def _ends_the_process(props):
    os.kill(os.getpid(), signal.SIGSEGV)


def _never_answers(props):
    time.sleep(600)


if mi.variant() is not None:
    register("bsdf", "ends_the_process", _ends_the_process)
    register("bsdf", "never_answers", _never_answers)
