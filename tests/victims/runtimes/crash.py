# SPDX-License-Identifier: Apache-2.0
# crash.py TRIGGER: faulthandler reports the fault.
import ctypes
import faulthandler
import os
import sys
import threading
import time


def idle() -> None:
    while True:
        time.sleep(0.002)


faulthandler.enable()
threading.Thread(target=idle, daemon=True).start()
while True:
    time.sleep(0.005)
    if os.path.exists(sys.argv[1]):
        os.remove(sys.argv[1])
        with open(sys.argv[1] + ".crashes", "a", encoding="ascii") as crashes:
            crashes.write(".")
        ctypes.string_at(8)
