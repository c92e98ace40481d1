"""Drives that are commanded by voltage, or told their gains anew, against SciPy's integrator."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy

import jaxid
from jaxid.control import PD, Impedance, OpenLoop, Sampled, Servo
from jaxid.effects import Coulomb, DCMotor, GearFriction, Motion, RotorInertia, Viscous
from jaxid.errors import FitError, ModelError, RecordingError
from jaxid.parameters import Scalar, parameter

# A hobby servo that lifts half a kilogram, and a rotor behind its gear.
INERTIA, WEIGHT = 0.0049, 0.48
MOTOR = {"kt": 0.33, "R": 4.3, "Fv": 0.006, "Ia": 0.0017}
GAIN, SUPPLY, STEP = 0.0029, 7.4, 0.005
TIMES = np.arange(0.0, 2.0, STEP)


class Pendulum(jaxid.arms.AbstractArm):
    """J a + G sin q."""

    J: Scalar = parameter(INERTIA, symbol="J", unit="kg·m²", lower=0.0, free=False)
    G: Scalar = parameter(WEIGHT, symbol="G", unit="N·m", free=False)

    @property
    def joints(self):
        """One."""
        return 1

    def mass_matrix(self, q):
        """`(1, 1)`."""
        return self.J[None, None]

    def bias(self, q, v):
        """`(1,)`."""
        return self.G * jnp.sin(q)


def pendulum(controller, *effects, motor=True):
    drive = [DCMotor(joint=1, constant=MOTOR["kt"], resistance=MOTOR["R"])] if motor else []
    own = [
        RotorInertia(joint=1, inertia=jnp.asarray(MOTOR["Ia"])),
        Viscous(joint=1, coefficient=jnp.asarray(MOTOR["Fv"])),
    ]
    return jaxid.ClosedLoop(
        arm=Pendulum(), controller=controller, effects=[*drive, *own, *effects], name="servo"
    )


def goal(kind):
    return 1.0 - np.cos(5 * TIMES) if kind else 0.8 * np.sin(TIMES**2)


def integrated(torque, q0=0.0):
    """q at every sample, of a pendulum under a torque of time in samples, q and v; by SciPy."""
    q, x = [], np.array([q0, 0.0])
    for k in range(len(TIMES)):
        q.append(x[0])

        def rate(t, x, k=k):
            pull = torque(k + t / STEP, *x) - MOTOR["Fv"] * x[1] - WEIGHT * np.sin(x[0])
            return [x[1], pull / (INERTIA + MOTOR["Ia"])]

        x = scipy.integrate.solve_ivp(rate, (0.0, 0.999999 * STEP), x, rtol=1e-8, atol=1e-10).y[
            :, -1
        ]
    return np.array(q)


def servo_torque(wanted, kp, on, supply=None, deadband=0.0, limit=np.inf):
    """The law and the motor, written down apart from jaxid."""
    supply = np.full(len(TIMES), SUPPLY) if supply is None else supply

    def torque(time, q, v):
        k = int(time)
        error = wanted[k] - q
        error = np.sign(error) * max(abs(error) - deadband, 0.0)
        volts = supply[k] * min(max(GAIN * kp[k] * error, -1.0), 1.0)
        current = (volts - MOTOR["kt"] * v) / MOTOR["R"]
        return on[k] * MOTOR["kt"] * min(max(current, -limit), limit)

    return torque


def recording(wanted, q, name="run", **held):
    """A recording whose voltage is a line, since nothing asks for it here."""
    return jaxid.Recording.from_arrays(TIMES, q, TIMES, q_ref=wanted, name=name, **held)


POWERED = np.ones(len(TIMES))
# Full duty at the start of a steep goal, and a fall with the drive off.
FALL = np.where(TIMES < 1.0, 1.0, 0.0)
SAG = SUPPLY - 0.8 * np.sin(5 * TIMES)


@pytest.mark.parametrize(
    ("kp", "on", "supply", "deadband", "limit"),
    [
        (800.0, POWERED, None, 0.0, np.inf),
        (200.0, FALL, None, 0.0, np.inf),
        (400.0, POWERED, SAG, 0.02, np.inf),
        (800.0, FALL, SAG, 0.0, 0.9),
    ],
)
def test_a_servo_moves_as_its_equations_say(kp, on, supply, deadband, limit):
    wanted = goal(kp == 800.0)
    kps = np.full(len(TIMES), kp)
    theirs = integrated(servo_torque(wanted, kps, on, supply, deadband, limit))
    law = Servo(gain=[GAIN], supply=[SUPPLY], deadband=deadband)
    loop = pendulum(law).with_values(imax1=limit)
    more = {} if supply is None else {"supply": supply}
    given = recording(wanted, theirs, kp=kp, on=on, **more)
    ours = jaxid.simulate(loop, given)[0]
    # A kink within one of our two steps a sample costs h² of a jump in jerk; 0.1 mrad of 1.2 rad.
    assert np.abs(ours.q[:, 0] - theirs).max() < 1e-4
    assert np.abs(ours.tau).max() <= (SUPPLY if supply is None else supply.max())
    assert np.all(ours.tau[on == 0] == 0)
    assert np.all(ours.delivered[on == 0] == 0)


def test_a_sampled_servo_ticks():
    wanted, kps = goal(0), np.full(len(TIMES), 400.0)
    held = [0.0]

    def torque(k, q, v):
        return MOTOR["kt"] * (held[0] - MOTOR["kt"] * v) / MOTOR["R"]

    q, x = [], np.zeros(2)
    for k in range(len(TIMES)):
        q.append(x[0])
        held[0] = SUPPLY * np.clip(GAIN * kps[k] * (wanted[k] - x[0]), -1, 1)

        def rate(t, x):
            pull = torque(0, *x) - MOTOR["Fv"] * x[1] - WEIGHT * np.sin(x[0])
            return [x[1], pull / (INERTIA + MOTOR["Ia"])]

        x = scipy.integrate.solve_ivp(rate, (0.0, STEP), x, rtol=1e-9, atol=1e-11).y[:, -1]
    law = Sampled(Servo(gain=[GAIN], supply=[SUPPLY]), every=STEP)
    assert law.judged == "position"
    ours = jaxid.simulate(pendulum(law), recording(wanted, np.array(q), kp=kps))[0]
    assert np.abs(ours.q[:, 0] - q).max() < 1e-6


def test_an_open_loop_is_driven_by_the_recorded_voltage():
    volts = SUPPLY * np.sin(7 * TIMES)

    def torque(time, q, v):
        # A recorded voltage goes as a line from sample to sample.
        u = np.interp(time, np.arange(len(volts)), volts)
        return FALL[int(time)] * MOTOR["kt"] * (u - MOTOR["kt"] * v) / MOTOR["R"]

    theirs = integrated(torque)
    given = jaxid.Recording.from_arrays(TIMES, theirs, volts, on=FALL, units={"tau": "V"})
    ours = jaxid.simulate(pendulum(OpenLoop()), given)[0]
    assert np.abs(ours.q[:, 0] - theirs).max() < 1e-4
    assert np.all(ours.delivered[FALL == 0] == 0)


def fitted(recordings):
    start = {"kt1": 0.4, "R1": 5.0, "Fv1": 0.01, "Ia1": 0.001}
    loop = pendulum(Servo(gain=[GAIN], supply=[SUPPLY])).with_values(**start)
    return jaxid.fit(loop, recordings, jaxid.OEM(start="given", progress=False))


def test_a_free_fall_tells_the_motor_from_viscous_friction():
    rng = np.random.default_rng(4)
    made = []
    for k, (kp, on) in enumerate(((150.0, POWERED), (600.0, POWERED), (300.0, FALL))):
        kps, wanted = np.full(len(TIMES), kp), goal(k)
        q = integrated(servo_torque(wanted, kps, on))
        made.append(recording(wanted, q + 5e-4 * rng.normal(size=len(q)), f"r{k}", kp=kp, on=on))
    fit = fitted(made)
    assert fit.succeeded
    # Compared are positions, whose error is that of the readings: 0.5 mrad.
    assert np.std(np.concatenate(fit.residuals)) == pytest.approx(5e-4, rel=0.05)
    found, std = (dict(zip(fit.names, x, strict=True)) for x in (fit.theta, fit.std))
    for name in MOTOR:
        assert abs(found[f"{name}1"] - MOTOR[name]) < 4 * std[f"{name}1"], name
    assert std["R1"] < 0.05 * MOTOR["R"]
    # Without it, a motor of another constant and less viscous friction do the same.
    alone = fitted(made[:2])
    found, wide = (dict(zip(alone.names, x, strict=True)) for x in (alone.theta, alone.std))
    assert not wide["R1"] < 5 * std["R1"]
    braking = MOTOR["kt"] ** 2 / MOTOR["R"] + MOTOR["Fv"]
    assert found["kt1"] ** 2 / found["R1"] + found["Fv1"] == pytest.approx(braking, rel=0.01)
    assert found["kt1"] / found["R1"] == pytest.approx(MOTOR["kt"] / MOTOR["R"], rel=0.01)
    comparison = jaxid.compare(fit, made[0])
    assert comparison.signal == "position"
    noise = 5e-4 / np.sqrt(np.mean(made[0].q ** 2))
    assert float(comparison.error_percent.iloc[0, 0]) == pytest.approx(100 * noise, rel=0.1)


def test_idim_takes_the_voltage_through_the_motor():
    kps, wanted = np.full(len(TIMES), 400.0), goal(0)
    torque = servo_torque(wanted, kps, POWERED)
    q = integrated(torque)
    volts = SUPPLY * np.clip(GAIN * 400.0 * (wanted - q), -1, 1)
    given = jaxid.Recording.from_arrays(TIMES, q, volts, q_ref=wanted, kp=400, on=1)
    loop = pendulum(Servo(gain=[GAIN], supply=[SUPPLY])).free("J")
    loop = loop.hold("Ia1", Ia1=0.0)
    fit = jaxid.fit(loop, given, jaxid.IDIM(jaxid.Filtering(cutoff=20.0, rate=50.0)))
    found = dict(zip(fit.names, fit.theta, strict=True))
    assert found["J"] == pytest.approx(INERTIA + MOTOR["Ia"], rel=0.03)
    # Goals hold, and a line through their samples is ahead of them by half a step, which damps.
    stiffness = MOTOR["kt"] / MOTOR["R"] * SUPPLY * GAIN * 400.0
    assert abs(found["Fv1"] - MOTOR["Fv"]) < stiffness * STEP


def test_a_drive_is_told_its_gains_anew():
    wanted, rate = goal(0), np.gradient(goal(0), TIMES)
    kp, kd = np.where(TIMES < 1, 6.0, 1.5), np.where(TIMES < 1, 0.05, 0.01)
    ahead, limit = 0.3 * WEIGHT * np.sin(wanted), 0.9

    def torque(time, q, v):
        k = int(time)
        asked = kp[k] * (wanted[k] - q) + kd[k] * (rate[k] - v) + ahead[k]
        return min(max(asked, -limit), limit)

    theirs = integrated(torque)
    given = recording(wanted, theirs, kp=kp, kd=kd, v_ref=rate, tau_ff=ahead)
    loop = pendulum(Impedance(limit=[limit]), motor=False)
    ours = jaxid.simulate(loop, given)[0]
    assert np.abs(ours.q[:, 0] - theirs).max() < 1e-4
    assert loop.controller.judged == "torque"
    with pytest.raises(ModelError, match="no kd"):
        jaxid.simulate(loop, recording(wanted, theirs, kp=kp))


def test_friction_in_a_gear_is_of_both_of_its_sides():
    effect = GearFriction(
        joint=1,
        drive=0.2,
        back=0.1,
        slow=0.3,
        slow_back=0.05,
        level=0.02,
        velocity=0.4,
        smoothing=1e-9,
    )
    one, zero = jnp.ones(1), jnp.zeros(())

    def at(tau, load, v):
        motion = Motion(zero, one, v * one, one, tau * one, jnp.zeros(0), jnp.asarray(0))
        return float(effect.torque(dataclasses.replace(motion, load=load * one))[0])

    slow = np.exp(-((0.2 / 0.4) ** 2)) * (0.02 + abs(0.3 * 0.5 - 0.05 * 0.8))
    assert at(0.5, -0.8, 0.2) == pytest.approx(abs(0.2 * 0.5 - 0.1 * 0.8) + slow, rel=1e-6)
    # It is there though the drive gives nothing.
    assert at(0.0, 0.8, -9.0) == pytest.approx(-0.1 * 0.8, rel=1e-6)


def test_friction_in_a_gear_has_a_slope_at_nothing():
    """A search looks for an effect by its slope at zero, where that of |Km tau| is zero."""
    one, tau, load = jnp.ones(1), 0.5, 0.8
    motion = Motion(jnp.zeros(()), one, 9.0 * one, one, tau * one, jnp.zeros(0), jnp.asarray(0))
    motion = dataclasses.replace(motion, load=load * one)

    def torque(drive, back):
        gear = GearFriction(joint=1, drive=drive, back=back, smoothing=1e-9)
        return gear.torque(motion)[0]

    assert jax.grad(lambda x: torque(x, None))(0.0) == pytest.approx(tau + load, rel=1e-6)
    both = jax.grad(torque, (0, 1))(0.0, 0.0)
    assert both == pytest.approx((tau, load), rel=1e-6)


def test_a_gear_sees_the_load_of_the_links():
    """The power that friction takes in a fall with the drive off is that of gravity's load."""
    ratio = 0.3
    on = np.zeros(len(TIMES))
    gear = GearFriction(joint=1, drive=ratio, smoothing=0.01, form=1.0)
    loop = pendulum(Servo(gain=[GAIN], supply=[SUPPLY]), gear).with_values(Fv1=0.0)
    q0 = np.full(len(TIMES), 1.2)
    given = recording(goal(0), q0 - 1e-9 * TIMES, on=on)
    run = jaxid.simulate(loop, given)[0]
    q, v = run.q[:, 0], run.v[:, 0]
    falling = slice(5, 20)
    assert np.all(v[falling] < -0.1)
    # While it falls, friction holds a share of the load: energy is lost in that proportion.
    kinetic = 0.5 * (INERTIA + MOTOR["Ia"]) * v**2
    freed = WEIGHT * (np.cos(q) - np.cos(1.2))
    np.testing.assert_allclose(kinetic[falling], (1 - ratio) * freed[falling], rtol=1e-3)


# --- signals that hold ---------------------------------------------------------------------------


def test_what_drives_are_told_is_read_sliced_and_kept(tmp_path):
    file = tmp_path / "run.csv"
    q = np.sin(TIMES)
    rows = np.column_stack([TIMES, q, 2 * q, q, 7.0 + 0 * q, TIMES < 1.5])
    header = "time,q_1,tau_1,q_ref_1,battery,on_1"
    np.savetxt(file, rows, delimiter=",", header=header, comments="")
    columns = {"kp": "400", "supply": "battery"}
    (found,) = jaxid.read(file, columns=columns, units={"tau": "mV"})
    assert found.held_names == ("kp", "supply", "on")
    np.testing.assert_array_equal(found.held_at(TIMES)["kp"], 400.0)
    np.testing.assert_allclose(found.tau[:, 0], 2e-3 * q)
    at = found.held_at(np.array([-1.0, 0.5 * STEP, 1.49, 1.4951, 99.0]))
    assert at["on"][:, 0].tolist() == [1.0, 1.0, 1.0, 1.0, 0.0]
    part = found.slice(1.0, None)
    assert part.held_at(TIMES[200:])["on"].sum() == 100
    again = jaxid.Recording.from_dataframe(found.to_dataframe())
    np.testing.assert_array_equal(again.supply, found.supply)


def test_recordings_of_a_fit_are_told_the_same_things():
    law = Servo(gain=[GAIN], supply=[SUPPLY])
    one = recording(goal(0), goal(0), "one", kp=400)
    with pytest.raises(RecordingError, match="two has no kp, which other recordings have"):
        jaxid.simulate(pendulum(law), [one, recording(goal(1), goal(1), "two")])
    # Where nothing is said of it, a drive is powered.
    both = [one, recording(goal(0), goal(0), "off", kp=400, on=0)]
    first, second = jaxid.simulate(pendulum(law), both)
    assert np.abs(first.tau).max() > 1
    assert np.all(second.tau == 0)


def test_a_discovery_under_a_servo_compares_positions():
    law = Servo(gain=[GAIN], supply=[SUPPLY])
    with pytest.raises(FitError, match="compares position"):
        jaxid.discover(
            pendulum(law, Coulomb(joint=1)),
            recording(goal(0), goal(0), kp=400),
            method=jaxid.OEM(output="torque"),
        )
    assert PD(Kp=[1.0], Kv=[1.0]).judged == "torque"
