"""Every decoder under test, each with the inputs that it meets; the decoders are in `decoders`."""

from functools import partial

from fuzz import corpora
from fuzz.decoders import files, messages, participants, records, replication
from fuzz.decoding import Target, refuses, stateless
from fuzz.toml_trees import Trees
from kantor_protocol.files.toml import TomlError
from kantor_protocol.scenario.errors import ScenarioError
from kantor_protocol.wire.messages import RefusedError, decode_inputs, decode_progress
from kantor_worldsim.record.run_folder import JOURNAL, MANIFEST

TARGETS: dict[str, Target] = {
    "news": Target(corpora.gossip, stateless(refuses(RefusedError, messages.gossip))),
    "signatures": Target(corpora.attested_gossip, stateless(messages.signatures)),
    "inputs": Target(corpora.inputs, stateless(refuses(RefusedError, decode_inputs))),
    "from-participant": Target(
        corpora.from_participants, stateless(refuses(RefusedError, messages.from_participant))
    ),
    "to-participant": Target(
        corpora.to_participants, stateless(refuses(RefusedError, messages.to_participant))
    ),
    "progress": Target(corpora.progress, stateless(refuses(RefusedError, decode_progress))),
    "array": Target(corpora.arrays, stateless(messages.array_content)),
    "record": Target(corpora.records, stateless(records.record)),
    "weights": Target(corpora.weights, messages.weights, in_kernels=True),
    "pairs": Target(corpora.packed, replication.pairs, in_kernels=True),
    "learn-ledger": Target(
        lambda: corpora.gossip_fields("ledger"), replication.merging("ledger"), True
    ),
    "learn-min": Target(lambda: corpora.gossip_fields("min"), replication.merging("min"), True),
    "learn-relay": Target(
        lambda: corpora.gossip_fields("centralized"),
        replication.merging("centralized", "supervisor"),
        True,
    ),
    "learn-registers": Target(
        lambda: corpora.gossip_fields("spectral"), replication.merging("spectral"), True
    ),
    "learn-map": Target(
        lambda: corpora.gossip_fields("market"), replication.merging("market"), True
    ),
    "learn-reborn": Target(
        lambda: corpora.gossip_fields("restarted"), replication.merging("restarted"), True
    ),
    "attested": Target(corpora.attested_gossip, replication.attesting(), True),
    "attested-registers": Target(
        lambda: corpora.attested_gossip("planner=spectral", "planner.modes=2"),
        replication.attesting("planner=spectral", "planner.modes=2"),
        True,
    ),
    "registers": Target(corpora.register_fields, replication.registers, True),
    "read-have": Target(
        lambda: corpora.gossip_fields("ledger"), stateless(replication.version_vector_lengths), True
    ),
    "evidence": Target(corpora.scans, replication.occupancy_log, True),
    "reader": Target(corpora.batches, records.batch_tables, True),
    "parts-of-news": Target(corpora.gossip, stateless(records.parts_of_gossip), True),
    "parts-of-weights": Target(corpora.weights, stateless(records.parts_of_weights), True),
    "robot": Target(lambda: corpora.gossip("ledger"), participants.stepping("ledger", "r1"), True),
    "reborn": Target(
        lambda: corpora.gossip("restarted"), participants.stepping("restarted", "r2"), True
    ),
    "supervisor": Target(
        lambda: corpora.gossip("centralized"),
        participants.stepping("centralized", "supervisor"),
        True,
    ),
    "mapper": Target(lambda: corpora.gossip("market"), participants.stepping("market", "r1"), True),
    "allocation": Target(
        lambda: corpora.gossip("allocated"), participants.stepping("allocated", "supervisor"), True
    ),
    "life": Target(corpora.inputs, participants.recovering("ledger", "r1"), True),
    "life-on-map": Target(corpora.inputs, participants.recovering("burgard", "r1"), True),
    "wal": Target(corpora.wals, partial(participants.wal, framed=True)),
    "wal-file": Target(corpora.wal_files, partial(participants.wal, framed=False)),
    "scenario-tree": Target(Trees, stateless(refuses(ScenarioError, files.scenario_tree))),
    "scenario-text": Target(
        corpora.scenarios, stateless(refuses(ScenarioError, files.scenario_text))
    ),
    "scenario-file": Target(corpora.scenarios, files.scenario_file),
    "toml": Target(corpora.scenarios, stateless(refuses(TomlError, files.toml_text))),
    "manifest": Target(corpora.manifests, files.manifest),
    "chaos-file": Target(corpora.chaos_files, files.chaos_file),
    "override": Target(corpora.overrides, stateless(refuses(ScenarioError, files.override))),
    "keys": Target(corpora.keys, stateless(files.key_expression)),
    "credentials": Target(corpora.identities, files.identity_file),
    "journal": Target(corpora.journals, stateless(records.journal)),
    "indexed-journal": Target(corpora.journals, records.indexed_journal),
    "opening": Target(corpora.journals, records.run_folder(JOURNAL)),
    "manifest-of-a-run": Target(corpora.manifests_of_runs, records.run_folder(MANIFEST)),
    "result": Target(corpora.results, records.result_file),
    "runs-of-sweep": Target(corpora.logs_of_runs, files.runs_of_sweep),
    "map-nav2": Target(corpora.nav2, files.map_file(".yaml")),
    "inputs-of-map": Target(corpora.nav2, files.inputs_of_map),
    "map-movingai": Target(corpora.moving_ai, files.map_file(".map")),
    "map-pgm": Target(lambda: corpora.pictures("PPM"), files.map_file(".pgm")),
    "map-png": Target(lambda: corpora.pictures("PNG", "BMP"), files.map_file(".png")),
    "map-tiff": Target(lambda: corpora.pictures("TIFF", "JPEG"), files.map_file(".tiff")),
    "points-csv": Target(corpora.tables_of_points, files.points_file(".csv")),
    "points-npy": Target(corpora.arrays_in_files, files.points_file(".npy")),
    "points-image": Target(lambda: corpora.pictures("PNG", "PPM"), files.points_file(".png")),
    "points-tiff": Target(
        lambda: corpora.pictures("TIFF", "JPEG", "BMP"), files.points_file(".tif")
    ),
}
"""Decoders by name. A name is part of the seed of its inputs: another name meets other inputs."""
