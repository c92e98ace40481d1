"""Drives in a simulator's terms, typed into MuJoCo."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxid
from jaxid.control import PD, PID, Impedance, Sampled, Servo, Tracking
from jaxid.effects import (
    Coulomb,
    DriveGain,
    JointElasticity,
    RotorInertia,
    Stribeck,
    TimeDelay,
    TorqueSaturation,
    Viscous,
)
from jaxid.errors import FitError
from jaxid.simulation.terms import joint_terms, unsaid
from tests.test_servo import (
    GAIN,
    INERTIA,
    MOTOR,
    STEP,
    SUPPLY,
    TIMES,
    WEIGHT,
    Pendulum,
    goal,
    pendulum,
    recording,
)

MJCF = """
<mujoco>
  <compiler autolimits="true"/>
  <option timestep="0.0005" gravity="0 0 -9.81" integrator="implicitfast"/>
  <worldbody><body>
    <joint name="j" axis="0 1 0" armature="{armature}" damping="{damping}"
           frictionloss="{frictionloss}"/>
    <inertial pos="0 0 -{length}" mass="{mass}" diaginertia="{rest} {rest} {rest}"/>
  </body></worldbody>
  <actuator><position joint="j" kp="{kp}" kv="{kd}" forcerange="-{forcerange} {forcerange}"/>
  </actuator>
</mujoco>
"""


def typed(terms, wanted, mujoco):
    """Positions of MuJoCo's pendulum with these terms, `(samples,)`."""
    # A point's inertia, and a little for the axes about which nothing turns.
    length = 0.1
    mass = WEIGHT / 9.81 / length
    rest = INERTIA - mass * length**2
    values = {n: getattr(terms, n) for n in vars(terms)}
    text = MJCF.format(length=length, mass=mass, rest=rest, **values)
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    steps, q = round(STEP / model.opt.timestep), []
    for target in wanted:
        q.append(float(data.qpos[0]))
        # About y, a body that hangs turns the other way round than about the plane's normal.
        data.ctrl[0] = target
        for _ in range(steps):
            mujoco.mj_step(model, data)
    return np.array(q)


@pytest.mark.parametrize(("kp", "dry"), [(1000.0, 0.0), (300.0, 0.03)])
def test_mujoco_moves_a_servo_with_the_terms_alike(kp, dry):
    mujoco = pytest.importorskip("mujoco")
    friction = Coulomb(joint=1, level=jnp.asarray(dry), smoothing=1e-3, form=1.0)
    law = Servo(gain=[GAIN], supply=[SUPPLY], damping=2e-4)
    loop = pendulum(law, friction)
    wanted = goal(kp == 1000.0)
    run = jaxid.simulate(loop, recording(wanted, np.zeros_like(TIMES) + 1e-9 * TIMES, kp=kp))[0]
    (terms,) = joint_terms(loop, {"kp": np.array([kp])})
    # At the higher gain the voltage is at its limit for a while.
    assert (np.abs(run.tau).max() == SUPPLY) == (kp == 1000.0)
    theirs = typed(terms, wanted, mujoco)
    # MuJoCo's own steps of half a millisecond are of first order, as dry friction's solver is.
    assert np.abs(run.q[:, 0] - theirs).max() < 0.01 * np.ptp(theirs)
    assert not unsaid(loop)


def test_terms_are_those_of_the_drive():
    law = Servo(gain=[GAIN], supply=[SUPPLY], damping=[1e-3])
    loop = pendulum(law, DriveGain(joint=1, gain=jnp.asarray(0.1)))
    (terms,) = joint_terms(loop, {"kp": np.array([200.0])})
    per_volt = 1.1 * MOTOR["kt"] / MOTOR["R"]
    assert terms.kp == pytest.approx(per_volt * SUPPLY * GAIN * 200)
    assert terms.kd == pytest.approx(per_volt * SUPPLY * 1e-3)
    assert terms.damping == pytest.approx(per_volt * MOTOR["kt"] + MOTOR["Fv"])
    assert terms.forcerange == pytest.approx(per_volt * SUPPLY)
    assert (terms.armature, terms.frictionloss, terms.delay) == (MOTOR["Ia"], 0.0, 0.0)

    own = [
        TimeDelay(joint=1, delay=jnp.asarray(0.004)),
        TorqueSaturation(joint=1, limit=jnp.asarray(3.0)),
    ]
    law = Sampled(PD(Kp=[40.0], Kv=[6.0]), every=0.002, delay=2, limit=[5.0])
    (terms,) = joint_terms(pendulum(law, *own, motor=False))
    assert (terms.kp, terms.kd, terms.forcerange) == pytest.approx((40.0, 6.0, 3.0))
    assert terms.delay == pytest.approx(0.008)

    (terms,) = joint_terms(pendulum(Impedance(), motor=False), {"kp": np.array([7.0])})
    assert (terms.kp, terms.kd, terms.forcerange) == (7.0, 0.0, np.inf)


def test_what_has_no_term_is_named_with_its_reason():
    soft = JointElasticity(joint=1, compliance=jnp.asarray(0.01))
    peak = Stribeck(joint=1, level=jnp.asarray(0.02))
    loop = pendulum(PID(Kp=[1.0], Ki=[1.0], Kd=[0.1]), peak, soft, motor=False)
    why = unsaid(loop)
    assert why[-1] == "an integral cannot be expressed by kp and kd"
    assert len(why) == 3
    assert "fall with speed" in why[2]
    assert "one rigid joint" in why[3]
    (terms,) = joint_terms(pendulum(Tracking(), motor=False))
    assert (terms.kp, terms.kd) == (None, None)
    limited = pendulum(Servo(gain=[GAIN], supply=[SUPPLY], deadband=0.01)).with_values(imax1=1.0)
    assert unsaid(limited)[-1].startswith("a deadband cannot be expressed by kp and kd; forcerange")
    (terms,) = joint_terms(limited)
    assert terms.forcerange == pytest.approx(MOTOR["kt"] * 1.0)


def test_every_choice_has_its_error():
    """What is left out costs, and what is fitted again instead costs less."""
    law = PD(Kp=[4.0], Kv=[0.02])
    peak = Stribeck(joint=1, level=jnp.asarray(0.1), velocity=jnp.asarray(0.5))
    loop = jaxid.ClosedLoop(
        arm=Pendulum(),
        controller=law,
        effects=[
            RotorInertia(joint=1, inertia=jnp.asarray(MOTOR["Ia"])),
            Viscous(joint=1, coefficient=jnp.asarray(MOTOR["Fv"])),
            Coulomb(joint=1, level=jnp.asarray(0.02)),
            peak,
        ],
        name="peak",
    )
    wanted = goal(0)
    given = recording(wanted, wanted)
    run = jaxid.simulate(loop, given)[0]
    rng = np.random.default_rng(0)
    tau = run.tau[:, 0] + 1e-3 * rng.normal(size=len(TIMES))
    made = jaxid.Recording.from_arrays(TIMES, run.q, tau, q_ref=wanted, name="run")
    method = jaxid.OEM(start="given", progress=False)
    found = jaxid.simulator_terms(loop, made, method=method)
    errors = found.errors["joint 1"] if "joint 1" in found.errors else found.errors.iloc[:, 0]
    assert list(found.errors.index) == [
        "as identified",
        "without stribeck on joint 1",
        "in these terms",
        "in these terms, fitted again",
    ]
    noise = 100 * 1e-3 / np.sqrt(np.mean(tau**2))
    assert errors.iloc[0] == pytest.approx(noise, rel=0.1)
    assert errors.iloc[1] == errors.iloc[2] > errors.iloc[3] > 4 * errors.iloc[0]
    # Dry friction takes the place of a part of the peak.
    assert found.joints[("run",)][0].frictionloss > 0.02
    shown = repr(found)
    assert "frictionloss does not fall with speed" in shown
    assert "armature" in shown
    with pytest.raises(FitError, match="no recordings"):
        jaxid.simulator_terms(loop)
