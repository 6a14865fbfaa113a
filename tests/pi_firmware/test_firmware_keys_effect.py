"""Each key of the payload's file has a test that sees what it does, and a new one needs its own."""

import ast
from pathlib import Path

import pytest
from test_firmware_settings import fields_of

from pi_firmware.settings import Settings

SEEN_BY: dict[str, tuple[str, ...]] = {
    # One live flight, and all that is heard, seen and answered around it.
    "live::test_it_says_its_name": ("payload_id",),
    "live::test_its_camera_is_the_one_named_and_is_started_anew_in_time": (
        "camera.uri",
        "supervision.frame_timeout_s",
    ),
    "live::test_pictures_have_the_configured_size_and_rate": (
        "camera.width_px",
        "camera.height_px",
        "camera.rate_hz",
    ),
    "live::test_frames_tell_the_exposure_and_gain_asked_for": ("camera.exposure_s", "camera.gain"),
    "live::test_packets_go_where_they_should_as_they_should": (
        "link.host",
        "link.port",
        "link.ssrc",
        "link.mtu_bytes",
    ),
    "live::test_what_was_sent_of_late_and_nothing_older_is_sent_again": ("link.history_s",),
    "live::test_the_battery_is_the_gauges_and_is_read_so_often": (
        "battery.uri",
        "battery.period_s",
    ),
    "live::test_a_low_battery_lowers_the_bit_rate": (
        "battery.low_percentage",
        "battery.low_bitrate_kbps",
    ),
    "live::test_an_encoder_that_must_not_adapt_does_not": ("encoder.adapt",),
    "live::test_no_command_goes_below_the_least_bit_rate": ("encoder.min_bitrate_kbps",),
    "live::test_the_autopilot_gets_poses_and_says_its_state_so_often": (
        "autopilot.uri",
        "autopilot.period_s",
    ),
    "live::test_the_radio_is_the_one_named": ("wifi.interface",),
    "live::test_health_comes_so_often": ("supervision.period_s",),
    "live::test_it_connects_and_listens_where_it_should": (
        "telemetry.connect",
        "telemetry.listen",
    ),
    # Short flights, by the video that leaves them or by how they end.
    "flight::test_what_is_flown_is_the_cameras": ("camera.uri",),
    "flight::test_a_gate_that_is_off_sends_what_it_would_have_dropped": ("gate.enabled",),
    "flight::test_each_of_the_gates_tests_can_be_left_out": (
        "gate.min_entropy_bits",
        "gate.min_sharpness_ratio",
        "gate.min_difference",
    ),
    "flight::test_the_entropys_threshold_and_hysteresis_decide": (
        "gate.min_entropy_bits",
        "gate.hysteresis_bits",
    ),
    "flight::test_heartbeats_come_as_often_as_configured": ("gate.heartbeat_s",),
    "flight::test_an_idr_follows_a_gap_of_the_configured_length": ("gate.idr_after_s",),
    "flight::test_an_idr_comes_each_so_many_frames": ("encoder.gop_frames",),
    "flight::test_the_encoder_makes_so_many_bits": ("encoder.bitrate_kbps",),
    "flight::test_recordings_are_made_from_the_start_in_their_folder": (
        "recording.folder",
        "recording.at_start",
    ),
    "flight::test_a_process_ends_after_so_many_restarts_and_so_many_reboot_the_board": (
        "supervision.restarts",
        "supervision.process_restarts",
        "supervision.state",
        "supervision.reboot_command",
    ),
    "flight::test_an_empty_battery_ends_the_flight_and_then_the_board": (
        "battery.critical_percentage",
        "battery.shutdown_command",
    ),
    "flight::test_telemetry_that_is_off_listens_nowhere": ("telemetry.enabled",),
    "flight::test_with_certificates_it_speaks_tls_and_encrypts_unless_told_otherwise": (
        "link.encrypted",
        "telemetry.certificates",
    ),
    "flight::test_without_a_key_video_leaves_the_machine_only_if_it_may": ("link.host",),
    "flight::test_a_ground_station_is_looked_for_on_the_interface_named": ("telemetry.discover",),
    # The objects that they configure.
    "rooms::test_a_key_is_seen_where_it_is_used": (
        "camera.exposure_s",
        "camera.gain",
        "camera.white_balance",
        "camera.focus_m",
        "encoder.name",
        "encoder.max_queue_s",
        "encoder.max_round_trip_s",
        "encoder.min_gop_frames",
        "battery.capacity_mAh",
        "battery.full_V",
        "battery.critical_V",
        "battery.confirm_readings",
        "autopilot.max_age_s",
        "autopilot.world_heading_deg",
        "autopilot.mount_roll_deg",
        "autopilot.mount_pitch_deg",
        "autopilot.mount_yaw_deg",
        "autopilot.mount_m",
        "autopilot.jump_m",
        "autopilot.jump_deg",
    ),
    "rooms::test_a_cell_of_more_resistance_holds_more_charge_at_the_same_voltage": (
        "battery.resistance_mohm",
        "battery.temperature_C",
    ),
    "rooms::test_corrections_are_as_many_as_assumed_and_allowed": (
        "link.correction",
        "link.assumed_loss",
    ),
    "rooms::test_a_radio_is_restarted_after_so_long_a_silence": ("wifi.restart_after_s",),
    "rooms::test_a_recordings_file_ends_at_its_size": ("recording.max_file_MB",),
    "rooms::test_old_recordings_go_when_all_are_too_large": ("recording.max_total_MB",),
    "rooms::test_nothing_is_recorded_where_too_little_is_free": ("recording.min_free_MB",),
    "rooms::test_a_recording_is_written_through_as_often_as_configured": ("recording.sync_s",),
}
"""The tests of `test_firmware_keys_*.py` by module and function, and the keys that each sees."""


def source_of(test: str) -> str:
    """The function's text with its decorators; fails when there is no such one."""
    module, _, name = test.partition("::")
    text = Path(__file__).with_name(f"test_firmware_keys_{module}.py").read_text()
    for node in ast.parse(text).body:
        if isinstance(node, ast.FunctionDef) and node.name == name:
            first = min([node.lineno, *(decorator.lineno for decorator in node.decorator_list)])
            return "\n".join(text.splitlines()[first - 1 : node.end_lineno])
    raise AssertionError(f"there is no {test}")


def test_each_key_of_the_settings_is_seen_and_nothing_else() -> None:
    seen = {key for keys in SEEN_BY.values() for key in keys}
    assert seen == {name for name, _ in fields_of(Settings)}


@pytest.mark.parametrize("test", SEEN_BY)
def test_each_of_these_tests_exists_and_says_its_keys(test: str) -> None:
    source = source_of(test)
    for key in SEEN_BY[test]:
        assert key in source, f"{test} does not mention {key}"
