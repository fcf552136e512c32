"""One Gymnasium environment behind one flat buffer.

A `Bridge` describes its environment (`describe`: spaces, columns, frames, factors of variation) and writes the outputs
of a reset, a step or a render into a single buffer, each at its own 64-byte aligned offset. The owner of the buffer
reads the outputs. The same class serves a worker process (`worker.py`, over shared memory) and the interpreter of
the Python package.

Columns come from two sources:

* the observation: a `Box` is `observation`, a `Dict` one column per key, a `Tuple` `observation_0`, `observation_1` …;
  nested spaces join their keys with `_`;
* the numeric entries of `info` of a first reset and step: bool, int and float scalars, and arrays of fixed shape.
  An entry that is missing from a later `info` keeps its last value in the episode, and is 0 until it first occurs, so
  a column never holds a NaN that the environment did not write. An entry that both lack has no column: a warning names it.

A name that the engine reserves gets the prefix `obs_` or `info_`; entries that begin with `_` are private.
"""

import ast
import contextlib
import difflib
import functools
import importlib.metadata
import inspect
import json
import math
import os
import struct
import threading
import warnings

import gymnasium
import numpy as np
from gymnasium import spaces

ALIGN = 64
# Environments of one process run one at a time: frames of pygame, for example, differ in some pixels when two threads draw.
RUNNING = threading.RLock()


def free_running():
    """Frees the lock in a forked process, which lacks the thread that held it. A thread that forks inside a call keeps it."""
    if not RUNNING._is_owned():
        RUNNING._at_fork_reinit()


if hasattr(os, 'register_at_fork'):
    os.register_at_fork(after_in_child=free_running)
# The header of the buffer: reward, goal distance; terminated, truncated, success.
HEAD = struct.Struct('<dd???')
# The index of the flag that a forked process sets, behind the header.
FORKED_AT = HEAD.size
# Columns that the engine adds itself.
RESERVED = frozenset(
    'action reward terminated truncated success step_idx episode_idx episode_seed ep_len ep_offset pixels goal'.split()
)
# `info` entries that go into the header.
IN_HEADER = frozenset(['success', 'is_success'])
# Among the known entries of `info`, the mark that a warning has named later ones.
LATE = object()
# The largest reward: rewards are stored in single precision.
MOST_REWARD = float(np.finfo(np.float32).max)
# The time limit of an environment that defines none.
DEFAULT_STEPS = 1000

RESET, STEP, STEP_AND_RENDER, RENDER = b'rsdp'


class Unsupported(Exception):
    """Raised when columns or actions cannot represent a space of the environment. The argument is the problem."""

    FIX = 'wrap the environment to change the space, or choose another environment'

    def __str__(self):
        return f'{self.args[0]}; {self.FIX}'


class InvalidRequest(ValueError):
    """Raised when a request names something that the environment lacks. The arguments are the problem and the fix."""

    def __str__(self):
        return '; '.join(self.args)


class Forked(BaseException):
    """Raised in a child process that the environment forked and that returned from a call of the environment."""


# ---- spaces ----


def bounds(values):
    """Bounds as JSON: one value if all are equal, None for an infinite bound."""
    flat = np.asarray(values).reshape(-1)
    if flat.size and (flat == flat[0]).all():
        flat = flat[:1]
    return [float(v) if math.isfinite(v) else None for v in flat]


def column_dtype(dtype):
    """The dtype of a column for values of this dtype."""
    dtype = np.dtype(dtype)
    if dtype.kind == 'b':
        return np.dtype(bool)
    if dtype == np.uint8:
        return dtype
    if dtype.kind in 'iu':
        small = dtype.itemsize < 4 or dtype == np.int32
        return np.dtype(np.int32 if small else np.int64)
    if dtype.kind == 'f':
        return np.dtype(np.float32 if dtype.itemsize <= 4 else np.float64)
    raise Unsupported(f'values of type {dtype} cannot be stored in a column')


def store(view, value, name):
    """Writes a value into a column: of the column's shape, and of its type. Integers and booleans are neither rounded nor
    wrapped; floats round to the precision of the column, but not to infinity."""
    value = np.asarray(value)
    # numpy would repeat a value along the axes of the column, parse strings, and drop imaginary parts.
    same = value.size == view.size and (value.size == 1 or value.shape[-view.ndim :] == view.shape)
    if not same:
        raise ValueError(f"'{name}' has shape {value.shape}, and its space declares {view.shape}")
    if value.dtype.kind not in 'biuf':
        raise ValueError(f"'{name}' has the type {value.dtype}: return real numbers, as its space declares")
    if value.dtype != view.dtype:
        if value.dtype.kind == view.dtype.kind == 'f':
            view[...] = value.reshape(view.shape)
            # One value that is not finite makes the sum of squares so.
            if math.isfinite(np.vdot(view, view)):
                return
        value = converted(value, view.dtype, name)
    view[...] = value.reshape(view.shape)


def converted(value, dtype, name):
    """A value in the type of its column. Raises a ValueError if that cannot hold it."""
    from_kind, to_float = value.dtype.kind, dtype.kind == 'f'
    # numpy counts 64-bit integers among those that every float64 holds.
    if not (to_float and from_kind in 'iu') and np.can_cast(value.dtype, dtype):
        return value
    with np.errstate(invalid='ignore', over='ignore'):
        stored = value.astype(dtype)
        if to_float and from_kind == 'f':
            fits = np.isfinite(stored)
        else:
            # numpy would compare a float with an integer in double precision.
            fits = (stored.astype(value.dtype) if to_float else stored) == value
    if np.count_nonzero(fits) == value.size:
        return stored
    if to_float and from_kind == 'f':
        fits |= ~np.isfinite(value)
    if not fits.all():
        raise ValueError(
            f"'{name}' has {value[~fits].flat[0]} ({value.dtype}), which its column of {dtype} cannot hold: return values of"
            ' the type that its space declares, or in info that of the first reset and step, wide enough for all (at most 64 bits)'
        )
    return stored


def box(low, high, shape, dtype):
    return {'type': 'Box', 'shape': list(shape), 'dtype': column_dtype(dtype).name, 'low': bounds(low), 'high': bounds(high)}


def multi(nvec, start):
    flat = [np.asarray(v).reshape(-1).tolist() for v in (nvec, start)]
    return {'type': 'MultiDiscrete', 'nvec': flat[0], 'start': flat[1]}


def leaves(space, name, path=()):
    """The leaf spaces of a nested space, in order: (name, path, space)."""
    if isinstance(space, (spaces.Dict, spaces.Tuple)):
        inside = space.spaces.items() if isinstance(space, spaces.Dict) else enumerate(space.spaces)
        # A key of the outermost Dict is a column name. Keys of inner spaces and of tuples are joined with `_`.
        above = '' if isinstance(space, spaces.Dict) and not path else f'{name}_'
        for key, part in inside:
            yield from leaves(part, f'{above}{key}', (*path, key))
    else:
        yield name, path, space


def described(space):
    """An observation's space as JSON, with the type and shape of its column."""
    if isinstance(space, spaces.Box):
        return box(space.low, space.high, space.shape, space.dtype), column_dtype(space.dtype), space.shape
    if isinstance(space, spaces.Discrete):
        return {'type': 'Discrete', 'n': int(space.n), 'start': int(space.start)}, np.dtype(np.int64), ()
    if isinstance(space, spaces.MultiDiscrete):
        # The elements of a `MultiDiscrete` space are 64-bit integers, so the column stores 64-bit integers.
        return multi(space.nvec, space.start), np.dtype(np.int64), space.shape
    if isinstance(space, spaces.MultiBinary):
        return box(np.zeros(space.shape), np.ones(space.shape), space.shape, bool), np.dtype(bool), space.shape
    return None, None, None


class Actions:
    """Converts actions from the buffer to the environment's action space."""

    def __init__(self, space):
        self.space = space
        parts = [part for _, _, part in leaves(space, 'action')]
        if all(isinstance(part, spaces.Box) and part.dtype.kind == 'f' for part in parts):
            self.dtype = np.dtype(np.float32)
            with np.errstate(over='ignore'):
                sides = ('low', 'high')
                low, high = np.float32([np.concatenate([getattr(p, s).reshape(-1) for p in parts]) for s in sides])
            # Actions are not clipped.
            shape = parts[0].shape if len(parts) == 1 else low.shape
            self.json = box(low, np.maximum(low, high), shape, np.float32)
        else:
            self.dtype = np.dtype(np.int64)
            nvec, start = zip(*map(self.choices, parts))
            if isinstance(space, spaces.Discrete):
                self.json = {'type': 'Discrete', 'n': int(space.n), 'start': int(space.start)}
            else:
                self.json = multi(np.concatenate(nvec), np.concatenate(start))
        self.len = sum(math.prod(part.shape or (1,)) for part in parts)
        if not self.len:
            raise Unsupported(f'the action space {space} has no elements')

    @staticmethod
    def choices(part):
        """The number of values of each integer of a space, and the first value of each."""
        if isinstance(part, spaces.Discrete):
            return np.array([part.n]), np.array([part.start])
        if isinstance(part, spaces.MultiDiscrete):
            return np.asarray(part.nvec).reshape(-1), np.asarray(part.start).reshape(-1)
        if isinstance(part, spaces.MultiBinary):
            n = math.prod(part.shape)
            return np.full(n, 2), np.zeros(n, np.int64)
        if isinstance(part, spaces.Box) and part.dtype.kind in 'iub':
            low, high = (np.asarray(v, np.int64).reshape(-1) for v in (part.low, part.high))
            return high - low + 1, low
        raise Unsupported(f'actions of {part}, alone or mixed with other spaces, are not supported')

    def read(self, values):
        """The action in the environment's action space; a copy, not a view of the buffer."""
        at = 0

        def take(space):
            nonlocal at
            if isinstance(space, spaces.Dict):
                return {key: take(part) for key, part in space.spaces.items()}
            if isinstance(space, spaces.Tuple):
                return tuple(take(part) for part in space.spaces)
            begin, at = at, at + math.prod(space.shape or (1,))
            if isinstance(space, spaces.Discrete):
                return int(values[begin])
            with np.errstate(over='ignore'):
                value = values[begin:at].astype(space.dtype).reshape(space.shape)
            if space.dtype == np.float16 and not np.isfinite(value).all():
                raise ValueError(f'the action {values[begin:at]} is outside the numbers of float16, the type of the action space')
            if isinstance(space, spaces.Box) and space.dtype == np.float64:
                # Rounding to single precision may move a bound outside the space.
                for side in (space.low, space.high):
                    value = np.where(side.astype(np.float32) == value, side, value)
            return value

        return take(self.space)


# ---- factors of variation ----


def factor(key, space):
    """A leaf of a `variation_space` as JSON, recognised by its attributes as in the reference implementation."""
    value = getattr(space, 'init_value', None)
    if value is None:
        value = getattr(space, 'value', None)
    if hasattr(space, 'nvec'):
        form, default = multi(space.nvec, getattr(space, 'start', np.zeros_like(space.nvec))), np.zeros_like(space.nvec)
    elif hasattr(space, 'n'):
        start = int(getattr(space, 'start', 0))
        form, default = {'type': 'Discrete', 'n': int(space.n), 'start': start}, start
    elif hasattr(space, 'low'):
        byte = space.dtype == np.uint8 and (space.low == 0).all() and (space.high == 255).all()
        colour = byte and space.shape == (3,)
        form = {'type': 'RGBBox'} if colour else box(space.low, space.high, space.shape, space.dtype)
        default = space.low
    else:
        return None
    value = default if value is None else value
    return {'key': key, 'space': form, 'init': np.asarray(value, np.float64).reshape(-1).tolist()}


def variation_space(env):
    """The `variation_space` of the outermost wrapper that has one, or of the environment."""
    while env is not None:
        space = getattr(env, 'variation_space', None)
        if space is not None:
            return space
        env = getattr(env, 'env', None)
    return None


def factors(space, prefix=''):
    """All leaves of a nested `variation_space`: (JSON, leaf), in sampling order."""
    inside = getattr(space, 'spaces', None)
    if not hasattr(inside, 'items'):
        return
    order = [key for key in getattr(space, '_sampling_order', ()) if key in inside]
    for key in [*order, *(key for key in inside if key not in order)]:
        leaf = inside[key]
        if hasattr(leaf, 'spaces'):
            yield from factors(leaf, f'{prefix}{key}.')
        else:
            form = factor(f'{prefix}{key}', leaf)
            if form is not None:
                yield form, leaf


# ---- states ----


# Names of methods that set a state, and the column that each method takes.
SETTERS = [(('set_state', '_set_state'), 'state'), (('set_goal_state', '_set_goal_state'), 'goal_state')]


def callables(env):
    """The methods that set a state: `swm_callables` if the environment defines it, else its methods of one argument with a
    name of `SETTERS`."""
    own = getattr(env.unwrapped, 'swm_callables', None)
    if own is not None:
        return list(own)
    found = []
    for names, column in SETTERS:
        for name in names:
            key = only_argument(getattr(env.unwrapped, name, None))
            if key is not None:
                found.append({'method': name, 'args': {key: {'value': column, 'in_dataset': True}}})
                break
        if not found:
            # Setting a goal without setting a state does not define a start.
            return []
    return found


def only_argument(method):
    """The name of the only required argument of a method, None if there are none or several."""
    try:
        parameters = inspect.signature(method).parameters.values()
    except (TypeError, ValueError):
        return None
    required = [p for p in parameters if p.default is p.empty and p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)]
    return required[0].name if len(required) == 1 and required[0].kind is not required[0].POSITIONAL_ONLY else None


def argument(value):
    """An argument from JSON: an array given by dtype, shape and hexadecimal bytes, or any other JSON value."""
    if isinstance(value, dict) and value.keys() == {'dtype', 'shape', 'data'}:
        array = np.frombuffer(bytes.fromhex(value['data']), value['dtype']).reshape(value['shape'])
        # A writable copy; scalars as NumPy scalars.
        return array.copy()[()]
    return value


# ---- frames ----


def is_frame(value):
    return getattr(value, 'dtype', None) == np.uint8 and getattr(value, 'ndim', 0) == 3 and value.shape[2] in (3, 4)


def numeric(value):
    """A scalar or array of `info` as an array, None for anything else."""
    if isinstance(value, (bool, int, float)) or hasattr(value, '__array__') and hasattr(value, 'dtype'):
        value = np.asarray(value)
        if value.dtype.kind in 'biuf' and value.size:
            return value
    return None


def one_at_a_time(method):
    """Makes a method wait until no other thread calls an environment."""

    @functools.wraps(method)
    def waiting(*arguments, **keywords):
        with RUNNING:
            return method(*arguments, **keywords)

    return waiting


def flag(value, name):
    """An end of an episode as a bool."""
    if value is True or value is False:
        return value
    array = np.asarray(value)
    if array.dtype.kind not in 'biuf' or array.size != 1 or array.item() not in (0, 1):
        raise ValueError(f'{name} is {value!r}: return True or False')
    return bool(array.item())


def number(reward):
    """A reward as a float; some environments return an array of one element, or a tensor."""
    array = np.asarray(reward.detach().cpu() if hasattr(reward, 'detach') else reward)
    if array.dtype.kind in 'biufO' and array.size == 1:
        with contextlib.suppress(TypeError, ValueError):
            return float(array.item())
    raise ValueError(f'the reward is {reward!r}: return a number')


class Bridge:
    """One environment and the buffer it writes into."""

    @one_at_a_time
    def __init__(self, env, max_episode_steps=None):
        """Runs a reset, a step and a render to determine the columns and the frame size."""
        self.env = env
        self.actions = Actions(env.action_space)
        self.factors = list(factors(variation_space(env)))
        limit = max_episode_steps or getattr(env.spec, 'max_episode_steps', None)
        # Native environments state it themselves.
        own = getattr(env.unwrapped, 'max_episode_steps', None)
        self.max_episode_steps = limit or (own if isinstance(own, int) and own > 0 else DEFAULT_STEPS)

        observation, first = env.reset(seed=0)
        env.action_space.seed(0)
        _, _, _, _, second = env.step(env.action_space.sample())
        names = set()
        self.size = FORKED_AT + 1
        self.action_at = self.allocate(self.actions.len * self.actions.dtype.itemsize)
        self.columns, self.observed, self.informed = [], [], []
        # Environments of this package have columns that experts read by name, take seeds of 64 bits, and compute their `info`
        # at any time.
        self.native = bool(getattr(env.unwrapped, 'swm_native', False))
        for name, path, space in leaves(env.observation_space, 'observation'):
            form, dtype, shape = described(space)
            if form is not None:
                name = self.column(names, name, 'obs_', dtype, shape)
                self.observed.append((path, name, form, dtype, shape, self.columns[-1]['offset']))
        if not self.observed:
            raise Unsupported(f'no observation of {env.observation_space} is an array of fixed shape')
        # Entries of `info`, sorted by name, because their order may vary.
        for key in sorted(key for key in {**first, **second} if isinstance(key, str)):
            values = [value for value in (numeric(info.get(key)) for info in (first, second)) if value is not None]
            fixed = len({value.shape for value in values}) == 1
            goal = key == 'goal' and values and is_frame(values[0])
            if fixed and not goal and key not in IN_HEADER and not key.startswith('_'):
                dtype = column_dtype(np.result_type(*values))
                name = self.column(names, key, 'info_', dtype, values[0].shape)
                self.informed.append((key, name, dtype, values[0].shape, self.columns[-1]['offset']))
        # The entries of `info` that may have a column: later ones are left out. Environments of a world share them in Python.
        self.known = {key for info in (first, second) for key, value in info.items() if value is not None}
        self.factors_at = self.allocate(8 * sum(len(form['init']) for form, _ in self.factors))

        self.no_frame, self.render_shape, self.frame_index = '', None, None
        frame = self.first_frame()
        if frame is not None:
            self.render_shape = frame.shape[:2]
            self.frame_at = self.allocate(math.prod(self.render_shape) * 3)
        goal = first.get('goal')
        # Native environments render the goal instead.
        self.render_goal = None
        if frame is not None and not is_frame(goal):
            goal = self.first_goal()
        self.goal_shape = goal.shape[:2] if is_frame(goal) else None
        if self.goal_shape:
            self.goal_at = self.allocate(math.prod(self.goal_shape) * 3)

        # Versions of the packages that define the environment's class and entry point, and of `swm_libraries`.
        modules = type(env.unwrapped).__module__, str(getattr(env.spec, 'entry_point', ''))
        packages = (module.partition(':')[0].partition('.')[0] for module in modules)
        self.libraries = {}
        for name in ('gymnasium', 'numpy', *packages, *getattr(env.unwrapped, 'swm_libraries', ())):
            try:
                self.libraries[name.replace('_', '-')] = importlib.metadata.version(name)
            except (importlib.metadata.PackageNotFoundError, ValueError):
                pass

    def id(self):
        """The name of the environment in messages."""
        return getattr(self.env.spec, 'id', self.env)

    def allocate(self, size):
        """Reserves the next `size` bytes of the buffer and returns their offset."""
        offset = -(-self.size // ALIGN) * ALIGN
        self.size = offset + size
        return offset

    def column(self, names, name, prefix, dtype, shape):
        if not self.native:
            name = name.replace('/', '_').replace(' ', '_')
        while name in RESERVED or name in names:
            name = prefix + name
        names.add(name)
        offset = self.allocate(math.prod(shape) * dtype.itemsize)
        self.columns.append({'name': name, 'dtype': dtype.name, 'shape': list(shape), 'offset': offset})
        return name

    def first_frame(self):
        """A frame from `render`, or an RGB observation; None, with the reason in `no_frame`, without either."""
        try:
            # Some environments without a render mode support `render`.
            frame = self.env.render() if self.env.render_mode in ('rgb_array', None) else None
            if is_frame(frame):
                return frame
            self.no_frame = f'render() gives {type(frame).__name__} in mode {self.env.render_mode!r}'
        except Exception as error:  # The environment is usable without frames.
            self.no_frame = f'render() raises {type(error).__name__}: {error}'
        for index, (_, _, _, dtype, shape, _) in enumerate(self.observed):
            if dtype == np.uint8 and len(shape) == 3 and shape[2] == 3:
                self.frame_index = index
                return np.empty(shape, np.uint8)
        return None

    def first_goal(self):
        """The frame of the environment's `render_goal`, which later resets call as well; None without such a method."""
        render = getattr(self.env.unwrapped, 'render_goal', None)
        try:
            goal = render() if callable(render) else None
        except Exception:  # Another method of this name.
            return None
        if not is_frame(goal):
            return None
        self.render_goal = render
        return goal

    def write_goal(self, info):
        """Writes the frame of the goal of an episode that has begun."""
        if self.goal is not None:
            goal = self.call(self.render_goal) if self.render_goal else info.get('goal')
            self.goal[...] = goal[..., :3] if is_frame(goal) else 0

    def describe(self):
        """The description of the environment, with offsets in the buffer, as JSON."""
        return json.dumps({
            'action': self.actions.json,
            'action_offset': self.action_at,
            'columns': self.columns,
            'observation': [[name, form] for _, name, form, *_ in self.observed],
            'factors': [form for form, _ in self.factors],
            'factors_offset': self.factors_at,
            'frame': self.render_shape and {'size': self.render_shape, 'offset': self.frame_at},
            'goal': self.goal_shape and {'size': self.goal_shape, 'offset': self.goal_at},
            'no_frame': self.no_frame,
            'native': self.native,
            'pixel_art': bool(getattr(self.env.unwrapped, 'swm_pixel_art', False)),
            'max_episode_steps': self.max_episode_steps,
            'libraries': self.libraries,
            'calls': callables(self.env),
            'size': self.size,
        })

    def attach(self, buffer):
        """Uses `buffer`, of `size` bytes, for all outputs."""
        self.buffer = buffer

        def view(offset, shape, dtype):
            return np.ndarray(shape, dtype, buffer, offset)

        self.action = view(self.action_at, self.actions.len, self.actions.dtype)
        self.observed_views = [(path, view(at, shape, dtype)) for path, _, _, dtype, shape, at in self.observed]
        self.informed_views = {key: view(at, shape, dtype) for key, _, dtype, shape, at in self.informed}
        self.frame = self.render_shape and view(self.frame_at, (*self.render_shape, 3), np.uint8)
        self.goal = self.goal_shape and view(self.goal_at, (*self.goal_shape, 3), np.uint8)
        self.factor_views, at = [], self.factors_at
        for form, leaf in self.factors:
            self.factor_views.append((leaf, view(at, len(form['init']), np.float64)))
            at += 8 * len(form['init'])
        self.spaces = {form['key']: (form, leaf) for form, leaf in self.factors}
        self.views = {c['name']: view(c['offset'], c['shape'], np.dtype(c['dtype'])) for c in self.columns}
        # Values of goal columns that stay the same throughout the episode.
        self.held = []
        # Whether a step said if the goal is reached.
        self.states_success, self.success = False, None

    def call(self, function, *arguments, **keywords):
        """Calls the environment. A child process that the environment forked does not continue: it would write into the
        buffer that it shares with its parent."""
        process = os.getpid()
        try:
            return function(*arguments, **keywords)
        finally:
            if os.getpid() != process:
                self.buffer[FORKED_AT] = 1
                raise Forked(f'process {process} forked process {os.getpid()}, which returned to the caller')

    @one_at_a_time
    def handle(self, op, payload):
        """Handles a request: its kind, and for a reset its arguments as JSON."""
        if op == STEP:
            self.step()
        elif op == STEP_AND_RENDER:
            self.step()
            self.render()
        elif op == RENDER:
            self.render()
        elif op == RESET:
            self.reset(**json.loads(payload))
        else:
            raise ValueError(f'unknown request {op}')

    def reset(self, seed, native_seed=None, variation=None, variation_values=None, recorded=None):
        """Starts an episode. A native environment takes `native_seed` in place of `seed`, which wrappers get. `variation` and
        `variation_values` become the `options` of the environment's reset; `recorded` are the arguments of
        `set_recorded_state`."""
        options = {}
        if variation is not None:
            options['variation'] = variation
        if variation_values:
            options['variation_values'] = {key: self.value(key, value) for key, value in variation_values.items()}
        if native_seed is not None:
            self.env.unwrapped.swm_seed = (seed, native_seed)
        observation, info = self.call(self.env.reset, seed=seed, options=options or None)
        for view in self.informed_views.values():
            view[...] = 0
        # A native environment updates the values when its space is read.
        variation_space(self.env)
        for leaf, view in self.factor_views:
            value = getattr(leaf, 'value', None)
            view[...] = np.asarray(leaf.init_value if value is None else value, np.float64).reshape(-1)
        self.held, self.success = [], None
        self.write(observation, 0.0, False, False, info)
        if recorded is not None:
            self.set_recorded_state(**recorded)
        self.write_goal(info)

    def set_recorded_state(self, calls, shown, held, unknown=()):
        """Sets a recorded state: calls methods of the environment, and writes the recorded values `shown` and `held` into
        the columns. The values `held` are written again after every step. The goal's columns `unknown` take the values that
        `_get_info()` of the environment has now, as many environments have; without it they become NaN."""
        for call in calls:
            self.call(self.method(call['method']), **{key: argument(value) for key, value in call['args'].items()})
        info = self.present_info() if unknown else {}
        for key, name, dtype, shape, _ in self.informed:
            if name not in unknown:
                continue
            value = numeric(info.get(key))
            if value is not None and value.shape == shape:
                self.views[name][...] = value
            elif not self.native:
                shown_now = 'shows the goal of the reset'
                if dtype.kind == 'f':
                    self.views[name][...] = math.nan
                    shown_now = 'is NaN'
                self.warn(
                    f"'{name}' {shown_now} until the first step: the dataset does not say what it is at the goal, and the environment"
                    ' has no method _get_info() that returns it'
                )
        shown, self.held = ([(self.views[name], argument(value)) for name, value in part.items()] for part in (shown, held))
        for view, value in [*shown, *self.held]:
            view[...] = np.reshape(value, view.shape)
        # The header that the reset wrote, and its success, describe another state.
        self.success = None
        HEAD.pack_into(self.buffer, 0, 0.0, math.inf, False, False, False)

    def present_info(self):
        """The `info` of the present state; empty for an environment that does not tell it."""
        describe = getattr(self.env.unwrapped, '_get_info', None)
        try:
            info = self.call(describe) if callable(describe) else None
        except Forked:
            raise
        except Exception:  # Another method of this name.
            info = None
        return info if isinstance(info, dict) else {}

    def method(self, name):
        """Finds a method by name in the environment, else in its wrappers, from the outermost to the innermost."""
        env, layers = self.env, [self.env.unwrapped]
        while env is not env.unwrapped:
            layers.append(env)
            env = env.env
        for layer in layers:
            found = getattr(layer, name, None)
            if callable(found):
                return found
        own = type(self.env.unwrapped)
        known = sorted(key for key in dir(own) if not hasattr(gymnasium.Env, key) and callable(getattr(own, key, None)))
        near = difflib.get_close_matches(name, known, 1)
        meant = f' (did you mean {near[0]}?)' if near else ''
        fix = f'its methods are {", ".join(known)}' if known else 'it has only the methods of gymnasium.Env'
        raise InvalidRequest(f"{own.__name__} has no method '{name}'{meant}", fix)

    def value(self, key, value):
        """A factor's value in the form of its space."""
        form, leaf = self.spaces[key]
        if form['space']['type'] == 'Discrete':
            return int(value[0])
        return np.asarray(value, leaf.dtype).reshape(leaf.shape)

    def step(self):
        """Takes the action in the buffer."""
        self.write(*self.call(self.env.step, self.actions.read(self.action)))

    def warn(self, text):
        """Warns of what the environment does. A worker process replaces this, and sends the text to its parent."""
        warnings.warn(text, stacklevel=3)

    def warn_of_late(self, info):
        """Warns, once, of entries of `info` that have no column because the first reset and step had none of the name."""
        late = [
            key
            for key, value in info.items()
            if isinstance(key, str) and key not in self.known and key[:1] != '_' and key not in IN_HEADER
            if numeric(value) is not None
        ]
        if late:
            self.known.add(LATE)
            names = ', '.join(map(repr, late[:5])) + f' and {len(late) - 5} more' * (len(late) > 5)
            self.warn(
                f"{self.id()}: {names} in info: not in the info of the first reset and step, so left out; return it there as"
                ' well, with 0 for no value (further ones are not named)'
            )

    def write(self, observation, reward, terminated, truncated, info):
        if not info.keys() <= self.known and LATE not in self.known:
            self.warn_of_late(info)
        for path, view in self.observed_views:
            value = observation
            for key in path:
                value = value[key]
            store(view, value, '_'.join(map(str, path)) or 'observation')
        for key, view in self.informed_views.items():
            value = info.get(key)
            if value is None:
                continue
            value = np.asarray(value)
            if value.shape != view.shape or (value.dtype.kind == 'f') > (view.dtype.kind == 'f'):
                raise ValueError(
                    f"info['{key}'] was {view.dtype} {list(view.shape)} at the first reset and step, and is"
                    f' {value.dtype} {list(value.shape)} now: keep its type and shape'
                )
            store(view, value, f'info.{key}')
        for view, value in self.held:
            view[...] = np.reshape(value, view.shape)
        terminated, truncated = flag(terminated, 'terminated'), flag(truncated, 'truncated')
        if not isinstance(reward, (float, int)):
            reward = float(reward) if isinstance(reward, np.floating) else number(reward)
        if abs(reward) > MOST_REWARD and abs(reward) != math.inf:
            raise ValueError(
                f'the reward of {self.id()} is {reward}: rewards are stored in single precision, which'
                f' ends at {MOST_REWARD:.1e}; scale it, for example with gymnasium.wrappers.TransformReward'
            )
        key = 'success' if 'success' in info else 'is_success'
        value = info.get(key)
        if value is None and key in info and self.states_success and (terminated or truncated):
            raise ValueError(f"info['{key}'] is None at the end of an episode: return True or False, as at earlier steps")
        if value is not None:
            self.success = flag(value, f"info['{key}']")
            self.states_success = True
            success = self.success
        else:
            # An end is no success where the episode has said false last.
            success = terminated and self.success is not False
        distance = info.get('goal_distance', math.inf)
        HEAD.pack_into(self.buffer, 0, float(reward), float(distance), terminated, truncated, success)

    def render(self):
        """Renders into the buffer."""
        if self.frame_index is not None:
            self.frame[...] = self.observed_views[self.frame_index][1]
            return
        frame = self.call(self.env.render)
        if not is_frame(frame) or frame.shape[:2] != self.render_shape:
            raise ValueError(
                f'render() gave {getattr(frame, "shape", type(frame).__name__)}, and {(*self.render_shape, 3)}'
                ' at the first reset and step: frames must keep their size'
            )
        self.frame[...] = frame[..., :3]

    def close(self):
        self.env.close()


# ---- environments by id ----


class Missing(Exception):
    """Raised when a package is missing. The arguments are the asset that installs it and the import error."""


CONSTANTS = {'true': True, 'false': False, 'none': None}


def literal(text):
    """The value of a command-line word: true, false, none, a Python literal, or else the text itself."""
    try:
        return CONSTANTS[text] if text in CONSTANTS else ast.literal_eval(text)
    except (ValueError, SyntaxError):
        return text


def make(id, options, wrappers=()):
    """Makes the environment of an id as a `Bridge`. `options` are arguments of `gymnasium.make`, as text or as values;
    `wrappers` are applied first to last.

    The engine enforces the time limit, so Gymnasium's own is disabled.
    """
    kwargs = {key: literal(text) if isinstance(text, str) else text for key, text in options.items()}
    try:
        if id.startswith('ALE/'):
            import ale_py

            gymnasium.register_envs(ale_py)
        elif id.startswith('swm/Craftax'):
            import swm_craftax

            swm_craftax.register()
    except ModuleNotFoundError as error:
        raise Missing('ale' if id.startswith('ALE/') else 'craftax', str(error)) from error
    module, _, name = id.rpartition(':')
    if module:
        importlib.import_module(module)
    spec = gymnasium.spec(name)
    limit = kwargs.pop('max_episode_steps', None) or spec.max_episode_steps
    settings = {'max_episode_steps': -1, 'disable_env_checker': True, **kwargs}
    try:
        env = gymnasium.make(spec, **{'render_mode': 'rgb_array', **settings})
    except TypeError as error:
        # Some environments take no argument `render_mode`.
        if 'render_mode' not in str(error) or 'render_mode' in kwargs:
            raise
        env = gymnasium.make(spec, **settings)
    for wrap in wrappers:
        try:
            env = wrap(env)
        except ValueError as error:
            if 'TimeLimit' not in str(error):
                raise
            raise ValueError(
                f'{error} The engine enforces the time limit, so environments have no TimeLimit here: give the wrapper one,'
                ' as in lambda env: TimeAwareObservation(TimeLimit(env, 100)) with the time limit of the World'
            ) from error
    return Bridge(env, limit)
