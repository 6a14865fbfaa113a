"""The readers that are fuzzed: module, longest input, and what of the system it is."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Reader:
    """One target: a module of `readers`; inputs are recipes, so few bytes make large files."""

    name: str
    reads: str
    most_bytes: int = 4096


READERS = (
    Reader("annexb", "H.264 access units and the SEI in them"),
    Reader("rtp", "RTP packets, reordered and put together"),
    Reader("retransmission", "RTP packets that were asked for again, and others"),
    Reader("correction", "RTP packets that correct others, genuine and forged"),
    Reader("rtcp", "what is asked of the payload, as RTCP and SRTCP"),
    Reader("slices", "H.264's parameter sets and slice headers"),
    Reader("assembly", "RTP packets to decoded pictures", 8192),
    Reader("srtp", "SRTP packets, authentic and forged"),
    Reader("messages", "telemetry, commands and answers"),
    Reader("telemetry", "what a listener keeps of several payloads"),
    Reader("notes", "the service's bus"),
    Reader("clock", "answers to questions for the time"),
    Reader("names", "keys, endpoints and device URIs"),
    Reader("recording", "MCAP recordings"),
    Reader("flight", "recordings as frames: video, camera, exposures, poses", 8192),
    Reader("resuming", "recordings that were cut, looked at by a service that starts"),
    Reader("video", "raw H.264 and video containers", 8192),
    Reader("maps", "map.toml, landmarks and keyframes"),
    Reader("observations", "a flight's observations for the refinement"),
    Reader("weights", "weights of safetensors, and networks built from them", 8192),
    Reader("model", "learned models: ONNX files", 32768),
    Reader("floorplan", "floorplan.yaml and its picture"),
    Reader("image", "image files"),
    Reader("camera", "camera files"),
    Reader("charuco", "files of boards to calibrate with"),
    Reader("tum", "TUM trajectories"),
    Reader("pairs", "PAIRS.csv"),
    Reader("distances", "DISTANCES.csv"),
    Reader("tags", "TAGS.toml"),
    Reader("picks", "PICKS.toml"),
    Reader("config", "payload.toml, station.toml, settings of mapping and localizer"),
    Reader("parts", "the budget's parts"),
    Reader("provisioning", "blimp.toml, wifi.toml and what the card makes of them"),
    Reader("bundle", "update bundles: tar and signed list"),
    Reader("bmap", "block maps of images"),
    Reader("card_state", "what a card keeps about itself"),
    Reader("keys_folder", "certificates, keys and access lists"),
    Reader("mavlink", "the autopilot's serial line"),
    Reader("poses", "poses on their way to the autopilot"),
    Reader("commands", "commands and their numbers"),
    Reader("board", "the kernel's files and the output of iw and ip"),
    Reader("web", "the dashboard's HTTP API"),
    Reader("live", "the dashboard's WebSocket"),
    Reader("cases", "replay cases, accepted runs and runs' folders"),
)  # fmt: skip
