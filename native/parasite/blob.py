# SPDX-License-Identifier: Apache-2.0
"""Writes parasite_blob.h: the injected code as an array, and its entry points.

usage: blob.py ELF BINARY
"""

import subprocess
import sys

ENTRIES = ("inj_run", "inj_enter", "inj_go_home", "inj_restore", "inj_end", "inj_sigreturn")


def main() -> None:
    elf, binary = sys.argv[1:]
    symbols = {}
    for line in subprocess.run(["nm", elf], capture_output=True, text=True, check=True).stdout.splitlines():
        address, _, name = line.split()
        symbols[name] = int(address, 16)
    with open(binary, "rb") as file:
        code = file.read()
    print("/* Made by parasite/blob.py: the injected code. */")
    for name in ENTRIES:
        print(f"#define {name.upper()}_OFFSET {symbols[name]}")
    print("static const unsigned char parasite_blob[] = {")
    for start in range(0, len(code), 16):
        print("\t" + " ".join(f"0x{byte:02x}," for byte in code[start : start + 16]))
    print("};")


main()
