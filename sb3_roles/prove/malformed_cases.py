"""Malformed configurations and command lines, as data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Case:
    """One wrong command.

    :param words: ``train.py`` or ``enjoy.py``, or a command of ``sb3-roles``, and its options; run
        in a folder of its own
    :param named: what the lines on stderr must name: key and range, or the closest match
    :param lines: problems, of which each must be one line
    :param files: name -> content, in the folder; a name that ends with ``/`` is a folder
    """

    words: tuple[str, ...]
    named: tuple[str, ...]
    lines: int = 1
    files: Mapping[str, str | bytes] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The command line, not too long."""
        text = " ".join(ascii(word)[1:-1] for word in self.words)
        given = next(iter(self.files.values()), "") if "bad.yml" in self.words else ""
        text += f" [{ascii(given)[1:-1]}]" if given else ""
        return text if len(text) <= 100 else f"{text[:97]}..."


def _config(text: str, *named: str, lines: int = 1, algo: str = "hmappo") -> Case:
    """A configuration: keys of one environment, in YAML's flow style."""
    return _file(f"default: {{n_timesteps: 100, {text}}}\n", *named, lines=lines, algo=algo)


def _file(content: str | bytes, *named: str, lines: int = 1, algo: str = "hmappo") -> Case:
    words = ("train.py", "--algo", algo, "-conf", "bad.yml")
    return Case(words, named, lines, {"bad.yml": content})


def _words(text: str, *named: str, **files: str | bytes) -> Case:
    return Case(tuple(text.split()), named, files=files)


_PLAN = "episodes: 3\nrows: {}\n"
_RUN = "algo: hmappo\nenv: area-search-v0\nseed: 0\nvec_env: auto\nn_timesteps: 100\n"
_LAUGHS = "a: &a [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{new}: &{new} [{', '.join([f'*{old}'] * 10)}]\n"
    for old, new in zip("abcdefg", "bcdefgh", strict=True)
)

CONFIGURATIONS: tuple[Case, ...] = (
    # Types and ranges
    _config("n_steps: 0", "n_steps must be a whole number in [1, 1e+06], got 0"),
    _config("n_steps: 2.5", "n_steps must be a whole number", "2.5"),
    _config("n_steps: true", "n_steps must be a whole number", "True"),
    _config("n_steps: [8]", "n_steps must be a whole number", "[8]"),
    _config("n_steps: {a: 1}", "n_steps must be a whole number"),
    _config("n_steps: null", "n_steps must be a whole number", "None"),
    _config("n_envs: 0", "n_envs must be a whole number in [1, 100000], got 0"),
    _config("gamma: 1.5", "gamma must be a number in [0, 1], got 1.5"),
    _config("gamma: -0.1", "gamma must be a number in [0, 1], got -0.1"),
    _config("gamma: .nan", "gamma must be a number in [0, 1], got nan"),
    _config("learning_rate: .inf", "learning_rate must be", "[0, 10]", "inf"),
    _config("learning_rate: -1.0e-3", "learning_rate must be", "[0, 10]"),
    _config("learning_rate: lin_-1", "learning_rate must be", "schedule such as lin_5.0e-4"),
    _config("learning_rate: lin_nan", "learning_rate must be", "schedule such as lin_5.0e-4"),
    _config("clip_range: 0", "clip_range must be a number in (0, 1]"),
    _config("max_grad_norm: 0", "max_grad_norm must be a number in (0, 1e+09], or null"),
    _config("target_kl: -0.1", "target_kl must be a number in (0, 1e+06]", algo="ppo"),
    _config("ent_coef: .nan", "ent_coef must be", "[0, 1e+06]", algo="a2c"),
    _config("cg_max_steps: 0", "cg_max_steps must be a whole number in [1, 10000]", algo="trpo"),
    _config("patience: 0", "patience must be a whole number in [1, 1e+06], or null", algo="gnn"),
    _config("normalize_advantage: 1", "normalize_advantage must be true or false, got 1"),
    _config("policy_kwargs: 3", "policy_kwargs must be keys and values, got 3"),
    _config("policy_kwargs: {role_arch: [8, 0]}", "role_arch entry must be", "[1, 65536]"),
    _config("policy_kwargs: {optimizer_kwargs: {betas: [0.9]}}", "optimizer_kwargs", "list of 2"),
    _config("policy_kwargs: {optimizer_kwargs: {betas: [0.9, 0.99, 0.999]}}", "betas", "2", "[0.9"),
    _config("policy_kwargs: {optimizer_kwargs: {eps: 0}}", "eps must be a number in (0, 1]"),
    _config("env_kwargs: {n_agents: 0}", "n_agents must be a whole number from 1 to 1024, got 0"),
    _config("env_kwargs: {free_fraction: .nan}", "free_fraction", "nan"),
    _config("env_kwargs: {horizon: [1]}", "horizon must be", "[1]"),
    _config("wrapper_kwargs: {role_every: 0}", "role_every must be a whole number in [1, 1e+06]"),
    _config("wrapper_kwargs: {role_weights: {explore: .inf}}", "role_weights explore must be"),
    # Unknown names
    _config("gama: 0.9", "unknown key 'gama'", "did you mean 'gamma'?"),
    _config("env_kwarg: {}", "did you mean 'env_kwargs'?"),
    _config("1: 2", "unknown key 1"),
    _config("policy: TeamPolicy", "policy is unknown value 'TeamPolicy'", "RolePolicy"),
    _config("policy_kwargs: {grph: true}", "did you mean 'graph'?"),
    _config("env_kwargs: {scene: hrad}", "did you mean 'hard'?"),
    _config("env_kwargs: {horizn: 5}", "did you mean 'horizon'?"),
    _config("env_kwargs: {sub_goal: assignd}", "did you mean 'assigned'?"),
    _config("wrapper_kwargs: {roles: [explore, covr]}", "did you mean 'cover'?"),
    _config("wrapper_kwargs: {role_control: nearst}", "did you mean 'nearest'?"),
    _config("seed: 3", "seed is no hyperparameter: give --seed"),
    # All at once
    _config(
        "gama: 1, n_steps: 0, env_kwargs: {scene: x}, policy_kwargs: {y: 1}",
        "gamma",
        "n_steps",
        "scene",
        "policy_kwargs",
        lines=4,
    ),
    # Values that do not go together
    _config("n_steps: 4, n_envs: 2, batch_size: 9", "batch_size must be at most", "8", "got 9"),
    _config("n_steps: 4, n_envs: 2, batch_size: 9", "batch_size must be at most", algo="ppo"),
    _config("n_envs: 2, rollout_groups: 3", "rollout_groups must be at most n_envs = 2"),
    _config("n_envs: 1, env_kwargs: {scene: [easy, hard]}", "n_envs must be at least", "2"),
    _config("env_kwargs: {n_targets: 600}", "n_targets must be between 1 and the 375"),
    _config(
        "wrapper_kwargs: {roles: [explore], primitive_weights: {explore: {}, cover: {}}}",
        "primitive_weights",
        "'cover'",
        "explore",
    ),
    _config(
        "wrapper_kwargs: {primitive_weights: {explore: {explore: 1.0}}}",
        "primitive_weights",
        "cover",
    ),
    _config("wrapper_kwargs: {roles: [cover, cover]}", "roles must be", "each once", "cover"),
    _config("wrapper_kwargs: {role_every: 2}", "role_every", "has no roles", algo="mappo"),
    _config("wrapper_kwargs: {role_every: 2}", "role_every must be 1", algo="recurrent_ppo"),
    _config("policy_kwargs: {n_heads: 3, hop_width: 8}", "n_heads must divide", algo="h2gnn"),
    _config("policy_kwargs: {optimizer_kwargs: {fused: true, foreach: true}}", "fused and foreach"),
    _config("policy_kwargs: {encoder: patches, norm_layer: group}", "norm_layer must be none"),
    _config("policy_kwargs: {actor_keys: [local, state]}", "actor_keys", "'state'"),
    _config("policy_kwargs: {goal_key: sub_goal}", "goal_key needs", "nearest, assigned, routes"),
    _config("wrapper_kwargs: {role_control: nearest}", "role_control needs", "nearest, assigned"),
    # YAML that is not what it looks like
    _config("learning_rate: 5e-4", "'5e-4', which YAML reads as text: write 5.0e-4"),
    _config("normalize_advantage: yes", "line 1", "yes", "write that"),
    _config("env_kwargs: {sub_goal: no}", "line 1", "no is true or false"),
    _config("n_steps: 1:30", "line 1", "'1:30' is 90"),
    _config("n_steps: 010", "line 1", "'010' is 8"),
    _config("n_envs: 2024-01-01", "line 1", "2024-01-01 is a date"),
    _config("gamma: 0.9, n_steps: 8, gamma: 0.8", "line 1", "'gamma' is given twice"),
    _config(f"n_steps: {'9' * 5000}", "not valid YAML", "a number of 5000 characters"),
    _config('policy: "\\e[31m\\nred"', "\\x1b[31m", "RolePolicy"),
    _file("default:\n\tn_steps: 8\n", "bad.yml", "line 2", "'\\t'"),
    _file("default:\n  n_timesteps: 9\n  n_steps: [8\n", "bad.yml", "line"),
    _file("default: {n_steps: 8}\ndefault: {n_steps: 9}\n", "line 2", "'default' is given twice"),
    _file("default: &a {env_kwargs: *a}\n", "bad.yml", "contains itself"),
    _file(f"{_LAUGHS}default: {{n_steps: *h}}\n", "bad.yml", "more than", "aliases"),
    _file("[" * 20_000, "bad.yml", "not valid YAML"),
    _file("default: !!python/object/apply:os.system [echo]\n", "line 1", "python/object"),
    _file("default: {}\n---\ndefault: {}\n", "bad.yml", "single document"),
    _file("", "bad.yml", "keys and values, got nothing"),
    _file("- n_steps: 8\n", "bad.yml", "keys and values, got list"),
    _file("default: 3\n", "bad.yml", "keys and values, got 3"),
    _file("area-serch-v0: {}\n", "bad.yml", "unknown environment", "did you mean"),
    _file(b"\x00\x01\x7fELF\x02" * 50, "bad.yml", "not valid YAML"),
    _file(b"default: {policy: \xff\xfe}\n", "bad.yml", "UTF-8"),
    _file("# " + "x" * 2_000_000, "bad.yml", "larger than 65536 bytes"),
    _file(f"default:\n  n_timesteps: 9\n  ? {'k' * 60_000}\n  : 1\n", "unknown key", "allowed are"),
)

COMMAND_LINES: tuple[Case, ...] = (
    _words("train.py --algo hmapo", "did you mean 'hmappo'?"),
    _words("train.py --algo hmappo,", "unknown algorithm ''", "hmappo"),
    _words("train.py --env area-serch-v0", "did you mean 'area-search-v0'?"),
    _words("train.py --env toy:", "unknown environment 'toy:'", "module:factory"),
    _words("train.py --gama 0.9", "unknown option '--gama'"),
    _words("train.py -n 0", "1 to 1000000000000", "'0'"),
    _words("train.py -n nan", "1 to 1000000000000", "'nan'"),
    _words("train.py -n 1e400", "1 to 1000000000000", "'1e400'"),
    _words("train.py -params n_steps:8 n_steps:9", "n_steps is given twice"),
    Case(
        ("train.py", "-params", "policy_kwargs:{graph: true, graph: false}"),
        ("policy_kwargs: not valid YAML", "'graph' is given twice"),
    ),
    _words("train.py -params policy_kwargs:[1", "policy_kwargs", "not valid YAML"),
    _words("train.py -params n_steps:010x", "n_steps must be a whole number"),
    _words("train.py --vary n_steps:8 n_steps:0", "n_steps must be", "[1, 1e+06]", "got 0"),
    _words("train.py --seed 4294967296", "from 0 to 4294967295"),
    _words("train.py --seed -1", "from 0 to 4294967295", "'-1'"),
    _words("train.py --n-seeds 1.5", "from 1 to 1000", "'1.5'"),
    _words("train.py --eval-episodes 0", "--eval-episodes", "from 1 to 1000000"),
    _words("train.py --num-threads 0", "--num-threads", "from 1 to 1024"),
    _words("train.py --device gpu", "allowed are auto, cpu, cuda"),
    _words("train.py --vec-env nativ", "did you mean 'native'?"),
    _words("train.py --scene hrad", "did you mean 'hard'?"),
    _words("train.py --n-agents 0", "n_agents", "from 1 to 1024, got 0"),
    _words("train.py --n-agents 2 --env-kwargs n_agents:3", "--n-agents", "not both"),
    _words("train.py -conf nowhere.yml", "nowhere.yml: No such file"),
    Case(("train.py", "-conf", "here"), ("here: Is a directory",), files={"here/": ""}),
    Case(
        ("train.py", "-conf", "a\nb\x1b[31m.yml"),
        ("a b\\x1b[31m.yml", "got nothing"),
        files={"a\nb\x1b[31m.yml": ""},
    ),
    Case(("train.py", "--algo", "hm\nappo\x07"), ("'hm\\nappo\\x07'", "did you mean 'hmappo'?")),
    _words("train.py --resume nowhere", "nowhere: no such run folder"),
    _words("train.py --resume nowhere --seed 3", "leave --seed out"),
    Case(
        ("train.py", "--resume", "run"), ("no run folder, without config.yml",), files={"run/": ""}
    ),
    Case(
        ("train.py", "--resume", "run"),
        ("config.yml", "later_key", "allowed are"),
        files={"run/config.yml": f"{_RUN}later_key: 1\n", "run/args.yml": "{}\n"},
    ),
    Case(
        ("train.py", "--resume", "run"),
        ("args.yml", "eval_freq must be from 0 to", "'often'"),
        files={"run/config.yml": _RUN, "run/args.yml": "eval_freq: often\n"},
    ),
    Case(
        ("train.py", "--resume", "run"),
        ("config.yml", "'seed' is given twice"),
        files={"run/config.yml": f"{_RUN}seed: 1\n", "run/args.yml": "{}\n"},
    ),
    Case(
        ("train.py", "-f", "logs"),
        ("logs", "is no folder"),
        files={"logs": "a file"},
    ),
    _words("enjoy.py --algo hmapo", "did you mean 'hmappo'?"),
    _words("enjoy.py -f nowhere", "no run of hmappo", "'nowhere'"),
    _words("enjoy.py --pretrained hmapo", "did you mean 'hmappo'?"),
    _words("enjoy.py --fps 0", "above 0, up to 240", "'0'"),
    _words("enjoy.py --video x.avi", "--video", ".mp4 or .gif"),
    _words("enjoy.py --episodes -1", "--episodes", "from 1 to 1000000"),
    Case(
        ("enjoy.py", "-f", "run"),
        ("config.yml", "did you mean 'gamma'?"),
        files={"run/config.yml": f"{_RUN}gama: 1\n"},
    ),
    _words("evaluate --controller hmapo", "did you mean 'hmappo'?"),
    _words("evaluate", "--controller"),
    _words("evaluate --controller random --scene hrad", "did you mean 'hard'?"),
    _words("evaluate --controller random --stochastic", "--stochastic", "only policies"),
    _words("evaluate --controller random,random", "'random' is given twice"),
    Case(
        ("evaluate", "--controller", "run"),
        ("config.yml", "n_steps must be", "[1, 1e+06]"),
        files={"run/config.yml": f"{_RUN}n_steps: 0\n"},
    ),
    _words("simulate --controller randm", "did you mean 'random'?"),
    _words("simulate --episodes 0", "from 1 to 10000000", "'0'"),
    _words("simulate --scene-options horizn:9", "did you mean 'horizon'?"),
    _words("simulate --scene-options free_fraction:nan", "free_fraction", "'nan'"),
    _words("simulate --out x.csv", "--out", ".parquet"),
    _words("simulate --out nowhere/x.parquet", "folder 'nowhere' does not exist"),
    _words("demonstrate --controller plan --out x.npz", "did you mean 'planner'?"),
    _words("demonstrate", "--out"),
    _words("demonstrate --out x.npz --n-agents 0", "n_agents", "from 1 to 1024"),
    Case(("demonstrate", "--out", "x.npz"), ("'x.npz' is a folder",), files={"x.npz/": ""}),
    _words("curves nowhere", "nowhere: no such run folder"),
    Case(
        ("curves", "run", "--metrics", "covr"),
        ("unknown metric 'covr'", "did you mean 'cover'?"),
        files={"run/config.yml": _RUN, "run/evaluations.csv": "env_steps,cover\n1,0.5\n"},
    ),
    Case(
        ("curves", "run"),
        ("evaluations.csv", "a row is damaged"),
        files={
            "run/config.yml": _RUN,
            "run/evaluations.csv": "env_steps,explo_paper,cover\nx,0.5,0.5\n",
        },
    ),
    Case(
        ("curves", "run"),
        ("config.yml", "not valid YAML"),
        files={
            "run/config.yml": "a: [",
            "run/evaluations.csv": "env_steps,explo_paper,cover\n1,0.5,0.5\n",
        },
    ),
    _words("curves nowhere --every 0", "--every", "above 0"),
    _words("records nowhere.parquet", "nowhere.parquet: No such file"),
    Case(("records", "here"), ("here: Is a directory",), files={"here/": ""}),
    Case(("records", "x.parquet"), ("x.parquet", "no Parquet file"), files={"x.parquet": "text"}),
    _words("tables --tables VI", "unknown table 'VI'", "did you mean 'V'?"),
    _words("tables --rows hmapo", "did you mean 'hmappo'?"),
    _words("tables --episodes 0", "--episodes", "from 1 to 1000000"),
    _words("tables --runs hmapo=x", "did you mean 'hmappo'?"),
    _words("tables --runs hmappo=nowhere", "nowhere", "no such run folder"),
    _words("tables --log-folder nowhere", "'nowhere' is no folder"),
    Case(("tables", "--plan", "bad.yml"), ("bad.yml",), files={"bad.yml": _PLAN}),
    Case(
        ("tables", "--plan", "bad.yml"),
        ("bad.yml", "'episodes' is given twice"),
        files={"bad.yml": f"episodes: 2\n{_PLAN}"},
    ),
    Case(("tables", "-o", "here"), ("here is no folder",), files={"here": "a file"}),
    _words("report --figures trainng", "did you mean 'training'?"),
    _words("report --jobs 2 --ray local", "--ray", "not allowed with"),
    _words("publish", "--runs ROW=RUN", "--scores"),
    _words("publish --runs hmapo=x", "did you mean 'hmappo'?"),
    _words("publish --runs hmappo=nowhere", "nowhere"),
    _words("publish --dtype bfloat16 --scores", "auto, float16, float32"),
    _words("ablations --studies grah", "unknown study 'grah'"),
    _words("ablations --n-agents four", "numbers of robots", "'four'"),
    _words("ablations --train --dry-run", "not both"),
    Case(("ablations", "--plan", "bad.yml"), ("bad.yml", "episodes"), files={"bad.yml": "seed: 2"}),
    _words("bench evn", "did you mean 'env'?"),
    _words("bench env --seconds-per-case inf", "above 0, up to 600", "'inf'"),
    _words("bench train --algo hmapo", "did you mean 'hmappo'?"),
    _words("bench growth --robots 0", "from 1 to 1024"),
    _words("prove R99", "unknown promise 'R99'"),
    _words("prove R16 --quick", "R16 has no short form"),
    _words("prove --seed x", "from 0 to 4294967295", "'x'"),
    _words("simulat", "did you mean 'simulate'?"),
)

CASES = CONFIGURATIONS + COMMAND_LINES
