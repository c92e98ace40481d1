"""One of several processes that fit the same recordings together; started by test_sharding.py.

python tests/distributed_fit.py PORT PROCESSES NUMBER
"""

import json
import sys

import jax
import numpy as np

port, processes, number = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
if processes > 1:
    jax.distributed.initialize(f"localhost:{port}", processes, number)

import jaxid  # noqa: E402

FILES = [f"jaxid/demo/{kind}/{name}.csv" for kind, name in (("clean", "fit_1"), ("clean", "fit_2"))]
mesh = jax.sharding.Mesh(np.array(jax.devices()), ("recordings",))
recordings = jaxid.read(*FILES, "jaxid/demo/clean/held_out.csv")
fit = jaxid.fit(jaxid.scara(), recordings, jaxid.OEM(start="given", initial="free", mesh=mesh))
print("RESULT", json.dumps([mesh.size, fit.theta.tolist(), fit.std.tolist()]))
