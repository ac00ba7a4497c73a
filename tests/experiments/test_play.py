"""The page's parts that need no browser: what is asked, computed, timed and let in."""

import contextlib
import dataclasses
import queue
import signal
import socket
import sys
import threading
import time
import types

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import own_robot
import pytest
import runs

import jaxpets
from experiments import build, model_file
from experiments.config import Config
from experiments.errors import CheckpointError, InterruptedRun, UsageError
from experiments.play import __main__ as command_line
from experiments.play.clock import Clock
from experiments.play.command import (
    NOTHING,
    TO_EXPLORE,
    Commands,
    bound,
    earned_of,
    reward_of,
)
from experiments.play.readout import curves, status, under_line
from experiments.play.session import Frame, History, Session
from jaxpets import envs, rewards

viser = pytest.importorskip("viser", reason="the extra jaxpets[play] is not installed")

import msgspec  # noqa: E402
import zstandard  # noqa: E402
from websockets.datastructures import Headers  # noqa: E402
from websockets.exceptions import InvalidStatus  # noqa: E402
from websockets.sync.client import connect  # noqa: E402

from experiments.play import (  # noqa: E402
    geometry,
    recorder,
    serve,
    server,
    source,
)
from experiments.play.controls import Controls, Press, Values  # noqa: E402
from experiments.play.live import Live  # noqa: E402
from experiments.play.page import Page  # noqa: E402
from experiments.play.plan_part import PlanPart  # noqa: E402
from experiments.play.scene import Look  # noqa: E402

STEP = 0.05


@pytest.fixture(scope="module")
def cheetah():
    return envs.make("pets/half_cheetah"), *jaxpets.pretrained("best")


@pytest.fixture(scope="module")
def commands(cheetah):
    robot, _, params = cheetah
    return Commands(robot, params)


@pytest.fixture(scope="module")
def live(cheetah):
    robot, model, params = cheetah
    box = {"action_low": robot.env.action_low, "action_high": robot.env.action_high}
    sizes = {"horizon": 4, "num_samples": 8, "num_elites": 2, "num_iterations": 2}
    search = jaxpets.optimizers.icem(**box, **sizes, unroll=False)
    rollout = jaxpets.fused_rollout(model, num_particles=5)
    return Live(robot, rollout, search, params, horizon=4)


# What is asked.


def test_a_choice_of_reward_is_that_reward(cheetah, commands):
    robot, _, params = cheetah
    draw = np.random.default_rng(0).normal
    obs, reached = (draw(size=(5, 2, 18)).astype(np.float32) for _ in range(2))
    action = draw(size=(6,)).astype(np.float32)
    reward = jax.jit(reward_of(robot))
    velocity = reached[..., commands.words["velocity"]]
    back = jax.tree.map(lambda x: x[1], robot.tasks.params)
    wanted = {
        "backward": robot.tasks.reward_fn(back, obs, action, reached),
        TO_EXPLORE: rewards.epistemic(
            rewards.max_variance(params), obs, action, reached
        ),
        "-(velocity - 2)**2 - 0.1 * effort": -((velocity - 2) ** 2)
        - 0.1 * np.sum(action**2),
    }
    for text, value in wanted.items():
        ask = commands.by_name if text in (*commands.tasks, TO_EXPLORE) else None
        ask = ask or commands.by_text
        choice = ask(commands.first, text).reward
        found = reward(choice, obs, action, reached)
        np.testing.assert_allclose(found, np.broadcast_to(value, (5, 2)), rtol=1e-5)
        earned = earned_of(robot)(choice, obs[0, 0], action, reached[0, 0])
        assert bool(jnp.isnan(earned)) == (text == TO_EXPLORE)
    assert reward._cache_size() == 1  # what is asked for is data: nothing compiles


def test_constants_of_a_trial_reach_its_task():
    robot = own_robot.robot("mujoco")
    params = types.SimpleNamespace(
        scaler=types.SimpleNamespace(low=-np.ones(4), high=np.ones(4)),
        max_logvar=jnp.zeros(4),
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rewards, "max_variance", lambda _: jnp.ones(4))
        choice = Commands(robot, params).first.reward
    choice = bound(choice, {"goal": jnp.float32(0.25)})
    obs = jnp.array([1.0, 0.0, 0.0, 0.0])
    assert earned_of(robot)(choice, obs, jnp.zeros(1), obs) == -0.75


def test_sliders_speak_the_language_of_the_line(commands):
    assert [x.word for x in commands.sliders] == ["velocity", "pitch_rate", "height"]
    asked = commands.by_sliders(commands.first, (2.0, 0.0, -0.1), 0.1)
    assert not asked.problem
    assert asked.line.startswith("-abs(velocity - 2) - ")
    assert "abs(pitch_rate)" in asked.line and "abs(height + 0.1)" in asked.line
    far = commands.by_sliders(commands.first, (1e5, 0.0, 0.0), 0.0)
    assert f"velocity - {commands.sliders[0].high:g})" in far.line
    assert "effort" not in far.line


def test_a_wrong_line_is_explained_and_the_old_reward_stays(commands):
    wrong = commands.by_text(commands.first, "2 * velocty")
    assert wrong.reward is commands.first.reward
    assert "'velocty'" in wrong.problem and "velocity" in wrong.problem
    assert wrong.column == 4
    assert "2 * ▸velocty" in under_line(wrong)
    html = under_line(commands.by_text(commands.first, "<script>"))
    assert "<script>" not in html
    assert commands.by_name(wrong, "no such task") is wrong


# What is computed.


def test_a_moment_that_is_gone_back_to_goes_on_as_before(live, commands):
    frames = [live.start(commands.first)]
    for _ in range(4):
        frames.append(live.step(frames[-1], commands.first, None)[0])
    again = live.step(frames[2], commands.first, None)[0]
    np.testing.assert_array_equal(again.obs, frames[3].obs)
    np.testing.assert_array_equal(again.ghosts, frames[3].ghosts)
    other = live.step(frames[2], commands.by_name(commands.first, "backward"), None)[0]
    assert (other.obs != frames[3].obs).any()
    members, horizon = 5, 4
    assert frames[1].ghosts.shape == (members, horizon + 1, 9)
    np.testing.assert_allclose(  # what it imagines begins where the robot is
        frames[1].ghosts[:, 0], np.broadcast_to(frames[0].qpos, (members, 9)), atol=1e-6
    )
    assert np.isfinite([x.promised for x in frames]).all()
    assert np.isfinite([x.disagreement for x in frames]).all()
    assert live._plan._cache_size() == live._step._cache_size() == 1


def test_a_push_is_felt(live, commands):
    first = live.start(commands.first)
    still = live.step(first, commands.first, None)[0]
    on = live.step(first, commands.first, "push on")[0]
    speed = commands.words["velocity"]
    assert on.obs[speed] > still.obs[speed] + 1.0


ROBOTS = "pets/half_cheetah", "dmc/cartpole", "gym/Ant-v5", "dmc/walker"


@pytest.mark.parametrize("name", ROBOTS)
def test_geoms_are_where_mujoco_has_them(name):
    model = envs.make(name).model
    data = mujoco.MjData(model)
    data.qpos[:] += 0.3
    mujoco.mj_forward(model, data)
    pose = geometry.poses(model)(np.array(data.qpos))
    np.testing.assert_allclose(pose.center, data.subtree_com[1], atol=1e-5)
    places = [geometry.placed(s, pose)[0] for s in geometry.shapes(model)]
    found = np.concatenate(places)
    hidden = model.geom_group >= 3
    round_ = np.isin(model.geom_type, (2, 4, 5, 6)) & ~hidden  # as one piece
    capsules = (model.geom_type == 3) & ~hidden
    for geom in np.flatnonzero(round_ | capsules):
        gaps = np.linalg.norm(found - data.geom_xpos[geom], axis=-1)
        assert gaps.min() < 1e-5, model.geom(geom).name
    ends = [
        data.geom_xpos[i] + sign * model.geom_size[i, 1] * data.geom_xmat[i][2::3]
        for i in np.flatnonzero(capsules)
        for sign in (-1, 1)
    ]
    for end in ends:
        assert np.linalg.norm(found - end, axis=-1).min() < 1e-5


@pytest.mark.parametrize("kind", ["sphere", "box", "can", "pill"])
def test_meshes_are_seen_from_outside(kind):
    vertices, faces = geometry._unit(kind)
    a, b, c = vertices[faces].transpose(1, 0, 2)
    assert (np.sum(np.cross(b - a, c - a) * (a + b + c), -1) > -1e-9).all()
    np.testing.assert_allclose([vertices.min(0), vertices.max(0)], [[-1] * 3, [1] * 3])


def test_between_two_moments_joints_turn_the_short_way():
    model = envs.make("gym/Ant-v5").model  # with a free joint
    first, second = np.array(model.qpos0), np.array(model.qpos0)
    second[0] += 1.0
    second[3:7] = np.sqrt(0.5), 0, 0, np.sqrt(0.5)  # a quarter of a turn
    half = geometry.between(model, first, second, 0.5)
    np.testing.assert_allclose(half[:3], [0.5, 0, 0.75])
    np.testing.assert_allclose(half[3:7], [np.cos(np.pi / 8), 0, 0, np.sin(np.pi / 8)])


# Time.


class Now:
    """A clock that tests set."""

    seconds = 0.0

    def __call__(self):
        return self.seconds


def lived(computing, steps=60, speed=1.0):
    """Returns a clock after so many steps, when each began, and when each is shown."""
    now = Now()
    clock, began, shown = Clock(STEP, now), [], []
    for i in range(steps):
        now.seconds += clock.wait()
        began.append(now.seconds)
        clock.begin(speed)
        now.seconds += computing(i)
        shown.append(clock.end())
    return clock, np.array(began), np.array(shown)


def test_a_quick_machine_keeps_time():
    clock, began, _ = lived(lambda _: 0.01)
    np.testing.assert_allclose(np.diff(began)[1:], STEP)
    assert clock.pace == pytest.approx(1.0)
    assert lived(lambda _: 0.01, speed=0.25)[0].pace == pytest.approx(0.25)


def test_a_slow_machine_has_a_slower_clock():
    clock, _, shown = lived(lambda _: 0.1)
    assert clock.rate == pytest.approx(10.0)
    assert "10.0 steps a second" in status(clock.rate, clock.pace, 1.0, False, 0.0, "")
    np.testing.assert_allclose(np.diff(shown)[30:], 0.1, rtol=0.05)


def test_lost_time_is_not_made_good_in_a_burst():
    _, began, shown = lived(lambda i: 1.0 if i == 30 else 0.01)
    assert np.diff(began).min() > 0.7 * STEP
    assert (np.diff(shown) >= 0).all()


def test_uneven_steps_look_even():
    draw = np.random.default_rng(0)
    _, _, shown = lived(lambda _: draw.uniform(0.005, 0.045), steps=200)
    assert np.abs(np.diff(shown)[50:] - STEP).max() < 0.3 * STEP


# Memory, and who orders what.


class Counter:
    """A world that counts, and breaks at a number."""

    step_time = STEP
    breaks_at = None

    def __init__(self):
        self.pushes, self.pushed = {"push on": np.ones(1)}, []

    def frame(self, number):
        none = float("nan")
        qpos = np.full(1, float(number))
        return Frame(
            number, qpos, qpos, np.zeros((0, 1, 1)), np.zeros(0, int), none, none, none,
            "", None,
        )  # fmt: skip

    def start(self, command):
        return self.frame(0)

    def step(self, frame, command, push):
        if frame.number + 1 == self.breaks_at:
            self.breaks_at = None
            raise ValueError("broken")
        self.pushed.append(push)
        return self.frame(frame.number + 1), ""


@pytest.fixture
def world():
    """A session that counts, and how to let it do n steps."""
    session = Session(Counter(), NOTHING)
    session.restart()

    def steps(n):
        session.is_paused = True
        for _ in range(n):
            session.step_once()
            session.tick(lambda _: None)
        return session.history.at(0.0).number

    return session, steps


def test_the_last_minute_is_remembered_and_no_more():
    history = History(1.0, STEP)
    frames = [Counter().frame(i) for i in range(50)]
    for frame in frames:
        history.append(frame)
    assert history.at(0.0) is frames[-1]
    assert history.at(0.5) is frames[-11]
    assert history.at(1e9) is history.recent(1e9)[0] is frames[30]
    assert history.seconds == pytest.approx(0.95)
    history.drop_after(frames[40])
    assert history.at(0.0) is frames[40]


def test_the_world_goes_on_from_a_moment_that_was_gone_back_to(world):
    session, steps = world
    assert steps(30) == 30
    session.pause(False)
    session.look_back(0.5)
    assert session.is_paused  # the world waits while somebody looks
    assert session.shown.at(time.monotonic())[1].number == 20
    session.go_on_from_here()
    assert not session.is_paused and session.back == 0
    assert steps(1) == 21


def test_pause_step_and_push(world):
    session, steps = world
    session.pause(True)
    session.tick(lambda _: None)
    assert session.history.at(0.0).number == 0
    session.push("push on")
    session.push("no such push")
    steps(2)
    assert session.stepper.pushed == ["push on", None]


def test_what_breaks_is_said_and_the_world_waits(capsys):
    session = Session(Counter(), NOTHING)
    session.stepper.breaks_at = 3
    thread = threading.Thread(target=session.run, args=(lambda _: None,), daemon=True)
    thread.start()
    deadline = time.monotonic() + 20
    while not session.is_paused and time.monotonic() < deadline:
        time.sleep(0.01)
    assert session.notice == "stopped by an error: broken"
    session.pause(False)
    while session.history.at(0.0).number < 4 and time.monotonic() < deadline:
        time.sleep(0.01)
    assert session.notice  # until somebody has had the time to read it
    session.stop()
    thread.join(5)
    assert session.history.at(0.0).number >= 4 and not thread.is_alive()
    assert "ValueError: broken" in capsys.readouterr().err


GARBAGE = [
    None,
    "",
    "x" * 10_000,
    [],
    {},
    float("nan"),
    -1e300,
    "nan",
    b"\xff",
    object(),
]


def test_controls_that_say_nonsense_change_nothing(world, commands):
    session, steps = world
    session.command = commands.first
    first = Values(commands.first.line, (0.0, 0.0, 0.0), 0.1, 0.0)
    controls = Controls(commands, first)
    for bad in GARBAGE:
        line = bad if not isinstance(bad, str) else first.line
        values = controls.apply(session, Values(line, (bad,) * 3, bad, bad), [])
        assert values.line == first.line
        for group in ("reward", "time", "speed", "push", "?"):
            controls.apply(session, first, [Press(group, str(bad))])
    assert session.command == commands.first
    assert steps(1) == 1


def test_a_storm_of_changes_is_one_change(world, commands):
    session, _ = world
    session.command = commands.first
    values = Values(commands.first.line, (0.0, 0.0, 0.0), 0.1, 0.0)
    controls = Controls(commands, values)
    moved = controls.apply(session, values._replace(sliders=(3.0, 0.0, 0.0)), [])
    assert moved.line.startswith("-abs(velocity - 3)")
    assert controls.apply(session, moved, []).line == moved.line
    typed = controls.apply(session, moved._replace(line="height"), [])
    assert (session.command.line, typed.line) == ("height", "height")
    controls.apply(session, typed, [Press("reward", "backward")])
    assert session.command.name == "backward"


def test_promises_are_compared_with_what_came_of_them():
    frames = [
        Counter().frame(i)._replace(promised=float(i), earned=10.0 + i, wanted="a")
        for i in range(1, 9)
    ]
    frames += [frames[-1]._replace(number=9, wanted="b")]
    found = curves(frames, 3, STEP)
    # What step i promised is of the steps i to i + 2.
    assert np.isnan(found.promised[:3]).all()
    np.testing.assert_array_equal(found.promised[3:8], np.arange(2.0, 7.0))
    np.testing.assert_array_equal(found.earned[3:8], np.arange(13.0, 18.0))
    assert np.isnan(found.promised[8])  # something else was asked for on the way
    assert found.seconds[-1] == 0


# Who gets in.


HERE = {"host": "localhost:8080"}
PASSED = [
    ("/", HERE, ""),
    ("/", {"host": "[::1]:80", "origin": "http://[::1]:80"}, ""),
    ("/secret/?a=b", {"host": "robot.example"}, "secret"),
]
REFUSED = [
    ("/", {"host": "[broken"}, ""),
    ("/", {}, ""),
    ("/", {"host": "evil.example"}, ""),  # its name, this machine's address
    ("/", HERE | {"origin": "http://evil.example"}, ""),
    ("/", HERE | {"origin": "null"}, ""),  # of a page in a frame that hides whose it is
    ("/", {"host": "robot.example"}, "secret"),
    ("/secre/", {"host": "robot.example"}, "secret"),
    ("/secrets/", {"host": "robot.example"}, "secret"),
    ("/\udcff/", {"host": "robot.example"}, "secret"),
    ("/secret/", {"host": "a.b", "origin": "http://evil.example"}, "secret"),
]


@pytest.mark.parametrize(("path", "headers", "token"), [*PASSED, *REFUSED])
def test_who_may_see_the_page(path, headers, token):
    found = server.refusal(path, Headers(**headers), token)
    assert bool(found) == ((path, headers, token) in REFUSED)


def said(port, *parts):
    """Sends parts, and returns what comes back."""
    with socket.create_connection(("127.0.0.1", port), timeout=5) as peer:
        for part in parts:
            peer.sendall(part)
        found = b""
        with contextlib.suppress(ConnectionResetError):  # it left while we spoke
            while data := peer.recv(4096):
                found += data
    return found


def test_the_door_is_guarded(capfd):
    listener = socket.create_server(("127.0.0.1", 0))
    port = listener.getsockname()[1]
    request = b"GET /%s HTTP/1.1\r\nHost: robot.example\r\n\r\n"
    with server.serving(listener, "secret") as page:
        assert page.get_port() == port
        whole = request % b"secret/"
        assert b"<title>" in said(port, whole[:9], whole[9:])
        for path in (b"", b"index.html", b"?secret/"):
            answer = said(port, request % path)
            assert answer.startswith(b"HTTP/1.1 403") and b"has a token" in answer
        noise = np.random.default_rng(0).bytes(20_000)
        for bad in (noise, b"\r\n\r\n", b"POST / HTTP/1.1\r\nHost: localhost\r\n\r\n"):
            assert b"200" not in said(port, bad)[:20]
        with pytest.raises(InvalidStatus, match="403"):
            connect(f"ws://127.0.0.1:{port}/")
        protocol = f"viser-v{viser.__version__}"
        with connect(f"ws://127.0.0.1:{port}/secret/", subprotocols=[protocol]) as peer:
            assert peer.recv()
        assert b"<title>" in said(port, whole)
    with pytest.raises(OSError, match="refused"):
        said(port, whole)
    assert capfd.readouterr() == ("", "")


# The whole of it, as a page would speak to it; see also test_play_browser.py.


class Visitor:
    """Speaks to a page as a browser does, and knows the controls that it is shown."""

    def __init__(self, address):
        protocol = f"viser-v{viser.__version__}"
        url = address.replace("http", "ws")
        self.socket = connect(url, subprotocols=[protocol], max_size=None)
        self.uuids, self.texts, self.places = {}, {}, set()
        camera = dict.fromkeys(("position", "look_at", "up_direction"), (1.0, 0.0, 0.0))
        sizes = dict.fromkeys(("fov", "near", "far", "image_height", "image_width"), 1)
        self.send("ViewerCameraMessage", wxyz=(1.0, 0.0, 0.0, 0.0), **camera, **sizes)

    def hear(self):
        packet = self.socket.recv(timeout=60)
        size, packed = np.frombuffer(packet[:16], np.uint64).tolist()
        plain = zstandard.ZstdDecompressor().decompress(packet[16 : 16 + packed], size)
        for message in msgspec.msgpack.decode(plain)["messages"]:
            props = message.get("props", message.get("updates", {}))
            if "label" in props:
                self.uuids.setdefault(props["label"], message["uuid"])
            for name in {"content", "value"} & props.keys():
                self.texts[message["uuid"], name] = str(props[name])
            if message.get("name") == "/robot/0":
                self.places.add(packet[16 + packed :])

    def until(self, is_so):
        deadline = time.monotonic() + 60
        while not is_so():
            assert time.monotonic() < deadline
            self.hear()

    def sees(self, text):
        self.until(lambda: any(text in shown for shown in self.texts.values()))

    def sets(self, name, value, field="value"):
        uuid, updates = self.uuids[name], {field: value}
        self.send("GuiUpdateMessage", uuid=uuid, updates=updates)

    def send(self, kind, **fields):
        self.socket.send(msgspec.msgpack.encode({"type": kind, **fields}))


@pytest.fixture
def visitor(monkeypatch):
    """Somebody who looks at a page on which little is planned."""
    found = source.found("pretrained/best")
    sizes = {"num_samples": 8, "num_elites": 2, "num_iterations": 2}
    small = found._replace(search=dataclasses.replace(found.search, **sizes))
    monkeypatch.setattr(source, "found", lambda *_, **__: small)
    told, is_over = queue.Queue(), threading.Event()
    options = serve.Options("pretrained/best", horizon=4, port=0, host="127.0.0.1")
    planned, search_of = [], build.optimizer
    monkeypatch.setattr(
        build, "optimizer", lambda *x: planned.append(x[0].horizon) or search_of(*x)
    )
    args = (options, is_over, told.put)
    thread = threading.Thread(target=serve.serve, args=args, kwargs={"rate": 10.0})
    thread.start()
    visitor = Visitor(told.get(timeout=60))
    yield visitor
    assert planned == [4]
    visitor.socket.close()
    is_over.set()
    thread.join(60)
    assert not thread.is_alive()


def test_a_page_does_what_visitors_ask(visitor):
    visitor.sees("It performs forward.")
    visitor.sets("acts by", "policy")  # which came with the model
    visitor.sees("by its policy, without a plan")
    visitor.sets("task", "backward")
    visitor.sees("-velocity - 0.1 * effort")
    visitor.sets("reward", "velocity + heigt")
    visitor.sees("There is no &#x27;heigt&#x27;, but height")
    for bad in (None, [1], {"a": 1}, float("nan"), 2**63):
        visitor.sets("velocity", bad)
    visitor.sets("velocity", 1, field="removed")
    for value in np.linspace(-6, 6, 500).round(1).tolist():
        visitor.sets("velocity", value)
    visitor.sets("velocity", 2.0)
    visitor.sees("-abs(velocity - 2) - ")
    visitor.sees("It does what the line says.")
    visitor.until(lambda: len(visitor.places) > 9)  # it moves
    visitor.sets("push", "push on")
    visitor.sets("or", "explore")
    visitor.sees("It seeks what its networks disagree about.")
    visitor.sets("go back", -0.5)
    visitor.sees("0.5 s ago")
    visitor.sets("and", "go on from here")
    visitor.sees("of the model's own noise")


def test_what_is_asked_for_while_an_order_is_obeyed_comes_next(
    cheetah, commands, live, monkeypatch
):
    """Whoever sees what was pressed may type before the line says it too."""
    robot, _, _ = cheetah
    session = Session(live, commands.first)
    session.restart()
    listener, obey = socket.create_server(("127.0.0.1", 0)), commands.by_name

    def interrupted(*order):
        page._part._line.value = "height"
        page._panel._back.value = -0.5
        return obey(*order)

    with server.serving(listener, "") as gui:
        page = Page(
            gui, robot, robot.name, session, "", commands,
            lambda panel: PlanPart(panel, commands, 4, has_policy=False),
        )  # fmt: skip
        monkeypatch.setattr(commands, "by_name", interrupted)
        page._panel._presses.put(Press("reward", "backward"))
        page.steer(session)
        assert session.command.line == commands.tasks["backward"]
        assert page._panel.back == 0.5
        page.steer(session)
        assert (session.command.line, session.command.problem) == ("height", "")


def test_what_was_seen_is_one_file(cheetah, commands, live):
    frames = [live.start(commands.first)]
    for _ in range(2):
        frames.append(live.step(frames[-1], commands.first, None)[0])
    page = recorder.html(cheetah[0], frames, Look())
    assert page.startswith(b"<!") and len(page) > 500_000


# The command line.


def error_of(capsys, *arguments):
    """Returns the exit code and the one line of an error."""
    code = command_line.main([*arguments])
    (line,) = [x for x in capsys.readouterr().err.splitlines() if x]
    return code, line


def test_without_viser_one_line_says_what_is_missing(capsys, monkeypatch):
    monkeypatch.delitem(sys.modules, "experiments.play.serve", raising=False)
    monkeypatch.delattr("experiments.play.serve", raising=False)
    monkeypatch.setitem(sys.modules, "viser", None)
    code, line = error_of(capsys)
    assert code == UsageError.exit_code
    need = 'pip install "jaxpets[play]" brings it.'
    assert line == f"error: viser is not installed; {need}"


@pytest.mark.parametrize("steps", ["0", "1001", "x"])
def test_a_horizon_is_a_number_of_steps(capsys, steps):
    with pytest.raises(SystemExit):
        command_line.main(["--horizon", steps])
    assert "argument --horizon" in capsys.readouterr().err


def test_what_is_wrong_is_a_line(capsys, tmp_path):
    (tmp_path / "x.safetensors").write_bytes(b"no model")
    cases = [
        (("--from", "pretrained/bst"), 2, "best"),
        (("--from", str(tmp_path / "none")), 2, "no such run or model"),
        (("--from", str(tmp_path)), 3, str(tmp_path)),
        (("--from", str(tmp_path / "x.safetensors")), 3, "x.safetensors"),
        (("--env", "dmc/cartpole"), 2, "of another robot"),
        (("--watch", str(tmp_path)), 3, str(tmp_path)),
    ]
    for arguments, wanted, part in cases:
        code, line = error_of(capsys, "--port", "0", *arguments)
        assert (code, part in line) == (wanted, True), (arguments, code, line)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        code, line = error_of(capsys, "--port", port)
    assert (code, f"--port {port}" in line) == (2, True)


def test_a_port_that_there_is_not_is_refused():
    """The system's look-up of an address takes what is left of it after 65536."""
    options = serve.Options("pretrained/best", port=65_536)
    with pytest.raises(UsageError, match="--port 65536 is not to be had"):
        serve._opened(options)
    with pytest.raises(
        UsageError, match=r"--host no\.\.such with port .* is not to be"
    ):
        serve._opened(serve.Options("pretrained/best", host="no..such"))


def test_a_signal_ends_it_at_once():
    process = runs.start("-u", "-m", "experiments.play", "--port", "0")
    assert process.stdout.readline().startswith("open http://localhost:")
    process.send_signal(signal.SIGINT)  # while it compiles
    start = time.monotonic()
    errors = process.communicate(timeout=60)[1]
    assert time.monotonic() - start < 15  # on a machine that does much else
    assert process.returncode == InterruptedRun.exit_code
    assert errors == "stopped: SIGINT.\n"


def test_a_file_of_a_model_runs_no_file(cheetah, tmp_path):
    _, model, params = cheetah
    for about, error in (
        ({"environment": "/tmp/my.py:robot"}, UsageError),
        ({"environment": "pets/half_cheetah", "search": {"settings": 3}}, None),
        ({}, UsageError),
    ):
        path = tmp_path / "m.safetensors"
        jaxpets.save_model(path, model, params, about=about)
        with pytest.raises(error or CheckpointError):
            source.found(str(path))


def test_a_file_that_says_no_search_is_planned_with_as_zero_shot_does(
    cheetah, tmp_path
):
    _, model, params = cheetah
    path = tmp_path / "m.safetensors"
    jaxpets.save_model(path, model, params, about={"environment": "pets/half_cheetah"})
    performed = model_file.config_of(path, Config()).task_planner
    assert source.found(str(path)).search == performed
    assert performed.num_particles == model.num_members
