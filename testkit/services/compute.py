# SPDX-License-Identifier: Apache-2.0
"""compute.py LIBRARY: the same computation again and again, by a library with threads of its own.

Prints "step N" for each that gives the same result as the first, else "WRONG".
"""

from __future__ import annotations

import itertools
import sys
import time
from collections.abc import Callable


def by_torch() -> Callable[[], bytes]:
    import torch  # type: ignore[import-not-found, unused-ignore]

    torch.manual_seed(1)
    torch.set_num_threads(4)
    net = torch.nn.Sequential(torch.nn.Conv2d(3, 16, 3), torch.nn.ReLU(), torch.nn.Conv2d(16, 4, 3))
    image = torch.rand(1, 3, 128, 128)

    def step() -> bytes:
        result: bytes = net(image).detach().numpy().tobytes()
        return result

    return step


def by_onnx() -> Callable[[], bytes]:
    sys.path.insert(0, "/opt/onnx")
    import numpy  # type: ignore[import-not-found, unused-ignore]
    import onnxruntime  # type: ignore[import-not-found, unused-ignore]
    from onnx import TensorProto, helper  # type: ignore[import-not-found, unused-ignore]

    def tensor(name: str) -> object:
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, [256, 256])

    nodes = [helper.make_node("MatMul", ["a", "b"], ["c"]), helper.make_node("Relu", ["c"], ["d"])]
    graph = helper.make_graph(nodes, "g", [tensor("a"), tensor("b")], [tensor("d")])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 4
    session = onnxruntime.InferenceSession(model.SerializeToString(), options)
    random = numpy.random.default_rng(1)
    inputs = {name: random.random((256, 256), dtype=numpy.float32) for name in "ab"}
    return lambda: session.run(None, inputs)[0].tobytes()


def by_opencv() -> Callable[[], bytes]:
    import cv2  # type: ignore[import-not-found, unused-ignore]
    import numpy  # type: ignore[import-not-found, unused-ignore]

    cv2.setNumThreads(4)
    image = numpy.random.default_rng(1).integers(0, 255, (480, 640, 3), dtype=numpy.uint8)
    return lambda: cv2.Canny(cv2.GaussianBlur(image, (7, 7), 2), 50, 150).tobytes()


def by_openblas() -> Callable[[], bytes]:
    import numpy  # type: ignore[import-not-found, unused-ignore]

    random = numpy.random.default_rng(1)
    a, b = random.random((300, 300)), random.random((300, 300))
    return lambda: (a @ b).tobytes()


def main() -> None:
    step = {"torch": by_torch, "onnx": by_onnx, "opencv": by_opencv, "openblas": by_openblas}[sys.argv[1]]()
    first = step()
    for n in itertools.count():
        print(f"step {n}" if step() == first else "WRONG", flush=True)
        time.sleep(0.02)


if __name__ == "__main__":
    main()
