"""One Gymnasium environment behind one flat buffer.

A `Bridge` finds out what its environment is (`describe`: spaces, columns, pictures, factors of variation), and then
writes whatever a reset, a step or a render brings into a single buffer, each thing at its own 64-byte aligned offset.
It returns nothing: whoever holds the buffer reads it. The same class serves a worker process (`worker.py`, over shared
memory) and an interpreter that lives in the caller's process.

Columns come from two places:

* the observation: a `Box` is `observation`, a `Dict` is a column a key, a `Tuple` `observation_0`, `observation_1` …;
  nested ones join their keys with `_`;
* the numeric entries of `info` that a reset and a step showed: bool, int and float scalars, and arrays of fixed shape.
  An entry that is missing from a later `info` keeps its last value in the episode, and is 0 until it was there once, so
  a column never holds a NaN that the environment did not write.

A name that the platform uses itself gets the prefix `obs_` or `info_`; entries that begin with `_` are private.
"""

import ast
import difflib
import importlib.metadata
import inspect
import json
import math
import struct

import gymnasium
import numpy as np
from gymnasium import spaces

ALIGN = 64
# The head of the buffer: reward, distance to the goal; terminated, truncated, success.
HEAD = struct.Struct('<dd???')
# Columns that the platform adds itself.
TAKEN = frozenset(
    'action reward terminated truncated success step_idx episode_idx episode_seed ep_len ep_offset pixels goal'.split()
)
# `info` entries that have another way to the platform.
ELSEWHERE = frozenset(['success', 'is_success'])
# Steps of an episode of an environment that names no limit.
STEPS = 1000

RESET, STEP, DRAWN_STEP, RENDER = b'rsdp'


class Unsupported(Exception):
    """The environment has something that no column or action of the platform can hold."""


class Wrong(ValueError):
    """Something was asked for that the environment does not have: what is wrong, and what to do."""

    def __str__(self):
        return '; '.join(self.args)


# ---- spaces ----


def bounds(values):
    """Bounds as JSON: one number where all are the same, None for an infinite one."""
    flat = np.asarray(values).reshape(-1)
    if flat.size and (flat == flat[0]).all():
        flat = flat[:1]
    return [float(v) if math.isfinite(v) else None for v in flat]


def held(dtype):
    """The type a column holds numbers of this type in."""
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
    raise Unsupported(f'numbers of type {dtype}')


def box(low, high, shape, dtype):
    return {'type': 'Box', 'shape': list(shape), 'dtype': held(dtype).name, 'low': bounds(low), 'high': bounds(high)}


def multi(nvec, start):
    flat = [np.asarray(v).reshape(-1).tolist() for v in (nvec, start)]
    return {'type': 'MultiDiscrete', 'nvec': flat[0], 'start': flat[1]}


def leaves(space, name, path=()):
    """The spaces inside a space that is made of others: (name, path, space), in their order."""
    if isinstance(space, (spaces.Dict, spaces.Tuple)):
        inside = space.spaces.items() if isinstance(space, spaces.Dict) else enumerate(space.spaces)
        # The keys of an observation are names enough; below them, and in a tuple, names are joined.
        above = '' if isinstance(space, spaces.Dict) and not path else f'{name}_'
        for key, part in inside:
            yield from leaves(part, f'{above}{key}', (*path, key))
    else:
        yield name, path, space


def described(space):
    """An observation's space as JSON, with the type and shape of its column."""
    if isinstance(space, spaces.Box):
        return box(space.low, space.high, space.shape, space.dtype), held(space.dtype), space.shape
    if isinstance(space, spaces.Discrete):
        return {'type': 'Discrete', 'n': int(space.n), 'start': int(space.start)}, np.dtype(np.int64), ()
    if isinstance(space, spaces.MultiDiscrete):
        # A column of 64-bit integers, as its space has.
        return multi(space.nvec, space.start), np.dtype(np.int64), space.shape
    if isinstance(space, spaces.MultiBinary):
        return box(np.zeros(space.shape), np.ones(space.shape), space.shape, bool), np.dtype(bool), space.shape
    return None, None, None


class Actions:
    """How the numbers of an action become what the environment takes."""

    def __init__(self, space):
        self.space = space
        parts = [part for _, _, part in leaves(space, 'action')]
        if all(isinstance(part, spaces.Box) and part.dtype.kind == 'f' for part in parts):
            self.dtype = np.dtype(np.float32)
            with np.errstate(over='ignore'):
                sides = ('low', 'high')
                low, high = np.float32([np.concatenate([getattr(p, s).reshape(-1) for p in parts]) for s in sides])
            # Random actions need bounds: a side without one counts as 1. Actions are passed on as they come.
            low = np.where(np.isfinite(low), low, -1)
            high = np.where(np.isfinite(high), high, 1)
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
            raise Unsupported(f'actions of {space}: there is nothing to choose')

    @staticmethod
    def choices(part):
        """How many values each integer of a space has, and the first of each."""
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
        raise Unsupported(f'actions of {part} (beside discrete ones, if there are several): wrap the environment')

    def read(self, numbers):
        """The environment's own form of an action; never a view of the buffer."""
        at = 0

        def take(space):
            nonlocal at
            if isinstance(space, spaces.Dict):
                return {key: take(part) for key, part in space.spaces.items()}
            if isinstance(space, spaces.Tuple):
                return tuple(take(part) for part in space.spaces)
            begin, at = at, at + math.prod(space.shape or (1,))
            if isinstance(space, spaces.Discrete):
                return int(numbers[begin])
            value = numbers[begin:at].astype(space.dtype).reshape(space.shape)
            if isinstance(space, spaces.Box) and space.dtype == np.float64:
                # A bound that single precision moved outside is the bound.
                for side in (space.low, space.high):
                    value = np.where(side.astype(np.float32) == value, side, value)
            return value

        return take(self.space)


# ---- factors of variation ----


def factor(key, space):
    """A leaf of a `variation_space` as JSON; the reference's protocol, by what the leaf has."""
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
    """The factors of an environment: its own, or those of the outermost wrapper that has some."""
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


# Methods that put an environment into a recorded state, by the names that say so, and the column each takes.
SETTERS = [(('set_state', '_set_state'), 'state'), (('set_goal_state', '_set_goal_state'), 'goal_state')]


def callables(env):
    """How an environment takes a state: `swm_callables` if it says so itself, else its methods of one argument with a
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
            # A goal alone is no start.
            return []
    return found


def only_argument(method):
    """The name of the one argument that a method needs, None if it needs others."""
    try:
        parameters = inspect.signature(method).parameters.values()
    except (TypeError, ValueError):
        return None
    free = [p for p in parameters if p.default is p.empty and p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)]
    return free[0].name if len(free) == 1 and free[0].kind is not free[0].POSITIONAL_ONLY else None


def argument(value):
    """An argument as it came: an array by its type, shape and bytes, or anything of JSON's."""
    if isinstance(value, dict) and value.keys() == {'dtype', 'shape', 'data'}:
        array = np.frombuffer(bytes.fromhex(value['data']), value['dtype']).reshape(value['shape'])
        # Its own, to be written into; numbers as numpy's numbers.
        return array.copy()[()]
    return value


# ---- pictures ----


def is_picture(value):
    return getattr(value, 'dtype', None) == np.uint8 and getattr(value, 'ndim', 0) == 3 and value.shape[2] in (3, 4)


def numeric(value):
    """A scalar or array of `info` as an array, None for anything else."""
    if isinstance(value, (bool, int, float)) or hasattr(value, '__array__') and hasattr(value, 'dtype'):
        value = np.asarray(value)
        if value.dtype.kind in 'biuf' and value.size:
            return value
    return None


class Bridge:
    """One environment and the buffer it writes into."""

    def __init__(self, env, max_episode_steps=None):
        """Tries the environment (a reset, a step, a picture) to learn what it is."""
        self.env = env
        self.actions = Actions(env.action_space)
        self.factors = list(factors(variation_space(env)))
        limit = max_episode_steps or getattr(env.spec, 'max_episode_steps', None)
        self.max_episode_steps = limit or STEPS

        observation, first = env.reset(seed=0)
        env.action_space.seed(0)
        _, _, _, _, second = env.step(env.action_space.sample())
        names = set()
        self.size = HEAD.size
        self.action_at = self.place(self.actions.len * self.actions.dtype.itemsize)
        self.columns, self.observed, self.informed = [], [], []
        for name, path, space in leaves(env.observation_space, 'observation'):
            form, dtype, shape = described(space)
            if form is not None:
                name = self.column(names, name, 'obs_', dtype, shape)
                self.observed.append((path, name, form, dtype, shape, self.columns[-1]['offset']))
        if not self.observed:
            raise Unsupported(f'observations of {env.observation_space}: none of them is an array of fixed shape')
        # Entries of `info`, in the order of their names: dictionaries of an environment need not keep one.
        for key in sorted(key for key in {**first, **second} if isinstance(key, str)):
            seen = [value for value in (numeric(info.get(key)) for info in (first, second)) if value is not None]
            fixed = len({value.shape for value in seen}) == 1
            goal = key == 'goal' and seen and is_picture(seen[0])
            if fixed and not goal and key not in ELSEWHERE and not key.startswith('_'):
                dtype = held(np.result_type(*seen))
                self.column(names, key, 'info_', dtype, seen[0].shape)
                self.informed.append((key, dtype, seen[0].shape, self.columns[-1]['offset']))
        self.factors_at = self.place(8 * sum(len(form['init']) for form, _ in self.factors))

        self.no_picture, self.render_shape, self.looks = '', None, None
        picture = self.first_picture()
        if picture is not None:
            self.render_shape = picture.shape[:2]
            self.picture_at = self.place(math.prod(self.render_shape) * 3)
        goal = first.get('goal')
        self.goal_shape = goal.shape[:2] if is_picture(goal) else None
        if self.goal_shape:
            self.goal_at = self.place(math.prod(self.goal_shape) * 3)

        # Versions of the packages behind it: that of its class, that of its registration, and those it names itself.
        modules = type(env.unwrapped).__module__, str(getattr(env.spec, 'entry_point', ''))
        packages = (module.partition(':')[0].partition('.')[0] for module in modules)
        self.libraries = {}
        for name in ('gymnasium', 'numpy', *packages, *getattr(env.unwrapped, 'swm_libraries', ())):
            try:
                self.libraries[name.replace('_', '-')] = importlib.metadata.version(name)
            except (importlib.metadata.PackageNotFoundError, ValueError):
                pass

    def place(self, size):
        """The offset of the next `size` bytes."""
        offset = -(-self.size // ALIGN) * ALIGN
        self.size = offset + size
        return offset

    def column(self, names, name, prefix, dtype, shape):
        name = name.replace('/', '_').replace(' ', '_')
        while name in TAKEN or name in names:
            name = prefix + name
        names.add(name)
        offset = self.place(math.prod(shape) * dtype.itemsize)
        self.columns.append({'name': name, 'dtype': dtype.name, 'shape': list(shape), 'offset': offset})
        return name

    def first_picture(self):
        """What `render` gives, or the observation that is a picture; None, and why, where there is neither."""
        try:
            # Some environments draw without having been asked for a mode.
            picture = self.env.render() if self.env.render_mode in ('rgb_array', None) else None
            if is_picture(picture):
                return picture
            self.no_picture = f'render() gives {type(picture).__name__} in mode {self.env.render_mode!r}'
        except Exception as error:  # Whatever its renderer raises, the environment can do without pictures.
            self.no_picture = f'render() raises {type(error).__name__}: {error}'
        for place, (_, _, _, dtype, shape, _) in enumerate(self.observed):
            if dtype == np.uint8 and len(shape) == 3 and shape[2] == 3:
                self.looks = place
                return np.empty(shape, np.uint8)
        return None

    def describe(self):
        """What the environment is, and where in the buffer everything lies, as JSON."""
        return json.dumps({
            'action': self.actions.json,
            'action_offset': self.action_at,
            'columns': self.columns,
            'observation': [[name, form] for _, name, form, *_ in self.observed],
            'factors': [form for form, _ in self.factors],
            'factors_offset': self.factors_at,
            'picture': self.render_shape and {'size': self.render_shape, 'offset': self.picture_at},
            'goal': self.goal_shape and {'size': self.goal_shape, 'offset': self.goal_at},
            'no_picture': self.no_picture,
            'pixel_art': bool(getattr(self.env.unwrapped, 'swm_pixel_art', False)),
            'max_episode_steps': self.max_episode_steps,
            'libraries': self.libraries,
            'calls': callables(self.env),
            'size': self.size,
        })

    def attach(self, buffer):
        """Writes into `buffer` from now on: `size` bytes."""
        self.buffer = buffer

        def view(offset, shape, dtype):
            return np.ndarray(shape, dtype, buffer, offset)

        self.action = view(self.action_at, self.actions.len, self.actions.dtype)
        self.observed_views = [(path, view(at, shape, dtype)) for path, _, _, dtype, shape, at in self.observed]
        self.informed_views = {key: view(at, shape, dtype) for key, dtype, shape, at in self.informed}
        self.picture = self.render_shape and view(self.picture_at, (*self.render_shape, 3), np.uint8)
        self.goal = self.goal_shape and view(self.goal_at, (*self.goal_shape, 3), np.uint8)
        self.factor_views, at = [], self.factors_at
        for form, leaf in self.factors:
            self.factor_views.append((leaf, view(at, len(form['init']), np.float64)))
            at += 8 * len(form['init'])
        self.spaces = {form['key']: (form, leaf) for form, leaf in self.factors}
        self.views = {c['name']: view(c['offset'], c['shape'], np.dtype(c['dtype'])) for c in self.columns}
        # What the columns of a recorded goal hold throughout the episode.
        self.held = []

    def handle(self, op, payload):
        """Does what a request asks: its kind, and for a reset its seed and options as JSON."""
        if op == STEP:
            self.step()
        elif op == DRAWN_STEP:
            self.step()
            self.render()
        elif op == RENDER:
            self.render()
        elif op == RESET:
            self.reset(**json.loads(payload))
        else:
            raise ValueError(f'unknown request {op}')

    def reset(self, seed, variation=None, variation_values=None, recorded=None):
        """Starts an episode. `variation` and `variation_values` become the `options` of the environment's reset; `recorded`
        is what `put` is given afterwards."""
        options = {}
        if variation is not None:
            options['variation'] = variation
        if variation_values:
            options['variation_values'] = {key: self.value(key, value) for key, value in variation_values.items()}
        observation, info = self.env.reset(seed=seed, options=options or None)
        for view in self.informed_views.values():
            view[...] = 0
        for leaf, view in self.factor_views:
            value = getattr(leaf, 'value', None)
            view[...] = np.asarray(leaf.init_value if value is None else value, np.float64).reshape(-1)
        if self.goal is not None:
            self.goal[...] = info['goal'][..., :3] if is_picture(info.get('goal')) else 0
        self.held = []
        self.write(observation, 0.0, False, False, info)
        if recorded is not None:
            self.put(**recorded)

    def put(self, calls, shown, held):
        """Puts the environment into a recorded state: calls methods of its own, (method, arguments) each, and shows in the
        columns what the recorded rows hold, in those of the goal from now on."""
        for call in calls:
            self.method(call['method'])(**{key: argument(value) for key, value in call['args'].items()})
        shown, self.held = ([(self.views[name], argument(value)) for name, value in part.items()] for part in (shown, held))
        for view, value in [*shown, *self.held]:
            view[...] = np.reshape(value, view.shape)
        # What the reset said of the goal was said of another state.
        HEAD.pack_into(self.buffer, 0, 0.0, math.inf, False, False, False)

    def method(self, name):
        """A method of the environment by its name; of its wrappers, from the outermost inwards, if it has none."""
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
        meant = f', did you mean {near[0]}' if near else ''
        fix = f'it has {", ".join(known)}' if known else 'it has none but those of gymnasium.Env'
        raise Wrong(f"{own.__name__} has no method '{name}'{meant}", fix)

    def value(self, key, value):
        """A factor's numbers in the form its space holds."""
        form, leaf = self.spaces[key]
        if form['space']['type'] == 'Discrete':
            return int(value[0])
        return np.asarray(value, leaf.dtype).reshape(leaf.shape)

    def step(self):
        """Takes the action in the buffer."""
        self.write(*self.env.step(self.actions.read(self.action)))

    def write(self, observation, reward, terminated, truncated, info):
        for path, view in self.observed_views:
            value = observation
            for key in path:
                value = value[key]
            view[...] = value
        for key, view in self.informed_views.items():
            value = info.get(key)
            if value is None:
                continue
            value = np.asarray(value)
            if value.shape != view.shape or (value.dtype.kind == 'f') > (view.dtype.kind == 'f'):
                raise ValueError(
                    f"info['{key}'] was {view.dtype} {list(view.shape)} when the environment was tried, and is"
                    f' {value.dtype} {list(value.shape)} now: give it one type and shape'
                )
            view[...] = value
        for view, value in self.held:
            view[...] = np.reshape(value, view.shape)
        success = info.get('success', info.get('is_success'))
        if success is None or success != success:
            success = terminated
        distance = info.get('goal_distance', math.inf)
        HEAD.pack_into(self.buffer, 0, float(reward), float(distance), bool(terminated), bool(truncated), bool(success))

    def render(self):
        """Draws into the buffer."""
        if self.looks is not None:
            self.picture[...] = self.observed_views[self.looks][1]
            return
        picture = self.env.render()
        if not is_picture(picture) or picture.shape[:2] != self.render_shape:
            raise ValueError(
                f'render() gave {getattr(picture, "shape", type(picture).__name__)}, and {(*self.render_shape, 3)}'
                ' when the environment was tried: pictures must keep their size'
            )
        self.picture[...] = picture[..., :3]

    def close(self):
        self.env.close()


# ---- by id ----


class Missing(Exception):
    """A package that must be installed: its name, and what for."""


WORDS = {'true': True, 'false': False, 'none': None}


def literal(text):
    """What a word of the command line means: a Python literal, a truth value, or else the text itself."""
    try:
        return WORDS[text] if text in WORDS else ast.literal_eval(text)
    except (ValueError, SyntaxError):
        return text


def make(id, options, wrappers=()):
    """The environment of an id as a `Bridge`; `options` are what `gymnasium.make` is given, as text or as they are, and
    `wrappers` what is put around it, first to last.

    The clock belongs to the platform: an environment's own limit is declared, not enforced by Gymnasium.
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
        # Some environments cannot be drawn at all.
        if 'render_mode' not in str(error) or 'render_mode' in kwargs:
            raise
        env = gymnasium.make(spec, **settings)
    for wrap in wrappers:
        env = wrap(env)
    return Bridge(env, limit)
