"""Each key of the payload's file has a test that sees what it does, and a new one needs its own."""

import importlib
import inspect

import pytest
from test_firmware_settings import fields_of

from pi_firmware.settings import Settings

SEEN_BY: dict[str, tuple[str, ...]] = {
    # One live flight, and all that is heard, seen and answered around it.
    "keys_live::test_it_says_its_name": ("payload_id",),
    "keys_live::test_its_camera_is_the_one_named_and_is_started_anew_in_time": (
        "camera.uri",
        "supervision.frame_timeout_s",
    ),
    "keys_live::test_pictures_have_the_configured_size_and_rate": (
        "camera.width_px",
        "camera.height_px",
        "camera.rate_hz",
    ),
    "keys_live::test_frames_tell_the_exposure_and_gain_asked_for": (
        "camera.exposure_s",
        "camera.gain",
    ),
    "keys_live::test_packets_go_where_they_should_as_they_should": (
        "link.host",
        "link.port",
        "link.ssrc",
        "link.mtu_bytes",
    ),
    "keys_live::test_what_was_sent_of_late_and_nothing_older_is_sent_again": ("link.history_s",),
    "keys_live::test_the_battery_is_the_gauges_and_is_read_so_often": (
        "battery.uri",
        "battery.period_s",
    ),
    "keys_live::test_a_low_battery_lowers_the_bit_rate": (
        "battery.low_percentage",
        "battery.low_bitrate_kbps",
    ),
    "keys_live::test_an_encoder_that_must_not_adapt_does_not": ("encoder.adapt",),
    "keys_live::test_no_command_goes_below_the_least_bit_rate": ("encoder.min_bitrate_kbps",),
    "keys_live::test_the_autopilot_gets_poses_and_says_its_state_so_often": (
        "autopilot.uri",
        "autopilot.period_s",
    ),
    "keys_live::test_the_radio_is_the_one_named": ("wifi.interface",),
    "keys_live::test_health_comes_so_often": ("supervision.period_s",),
    "keys_live::test_it_connects_and_listens_where_it_should": (
        "telemetry.connect",
        "telemetry.listen",
    ),
    # Short flights, by the video that leaves them or by how they end.
    "keys_flight::test_an_idr_follows_a_gap_of_the_configured_length": ("gate.idr_after_s",),
    "keys_flight::test_an_idr_comes_each_so_many_frames_of_so_many_bits": (
        "encoder.gop_frames",
        "encoder.bitrate_kbps",
    ),
    "keys_flight::test_telemetry_that_is_off_listens_nowhere": ("telemetry.enabled",),
    "keys_flight::test_with_certificates_it_speaks_tls_and_sends_plain_video_if_told_to": (
        "link.encrypted",
        "telemetry.certificates",
    ),
    "orders::test_the_board_ends_by_command_after_all_else": (
        "recording.folder",
        "recording.at_start",
    ),
    "orders::test_a_critical_battery_ends_recording_and_flight_and_then_the_board": (
        "battery.critical_percentage",
        "battery.shutdown_command",
    ),
    "supervision::test_a_process_that_cannot_help_itself_ends_and_the_next_reboots_the_board": (
        "supervision.restarts",
        "supervision.process_restarts",
        "supervision.state",
        "supervision.reboot_command",
    ),
    # The objects that they configure.
    "gate::test_disabled_gate_passes_everything": ("gate.enabled",),
    "gate::test_gate_reopens_only_above_the_hysteresis": (
        "gate.min_entropy_bits",
        "gate.hysteresis_bits",
    ),
    "gate::test_a_frame_far_blurrier_than_those_before_is_gated_until_it_is_sharp_again": (
        "gate.min_sharpness_ratio",
    ),
    "gate::test_a_frame_like_the_last_one_sent_is_gated_but_slow_drift_is_not": (
        "gate.min_difference",
    ),
    "gate::test_heartbeat_counts_from_the_last_frame_sent": ("gate.heartbeat_s",),
    "keys_rooms::test_a_key_is_seen_where_it_is_used": (
        "encoder.max_queue_s",
        "encoder.max_round_trip_s",
        "encoder.min_gop_frames",
        "battery.capacity_mAh",
        "battery.full_V",
        "battery.critical_V",
        "battery.confirm_readings",
        "autopilot.jump_m",
        "autopilot.jump_deg",
    ),
    "keys_rooms::test_a_cell_of_more_resistance_holds_more_charge_at_the_same_voltage": (
        "battery.resistance_mohm",
        "battery.temperature_C",
    ),
    "keys_rooms::test_corrections_are_as_many_as_assumed_and_allowed": (
        "link.correction",
        "link.assumed_loss",
    ),
    "keys_rooms::test_a_recording_is_written_through_as_often_as_configured": ("recording.sync_s",),
    "camera_libcamera::test_what_the_configuration_fixes_is_asked_of_libcamera": (
        "camera.exposure_s",
        "camera.gain",
        "camera.white_balance",
        "camera.focus_m",
    ),
    "devices::test_the_pis_encoder_is_told_its_level_and_repeats_its_parameter_sets": (
        "encoder.name",
    ),
    "autopilot_poses::test_hand_worked_poses": (
        "autopilot.world_heading_deg",
        "autopilot.mount_roll_deg",
        "autopilot.mount_pitch_deg",
        "autopilot.mount_yaw_deg",
        "autopilot.mount_m",
    ),
    "autopilot_poses::test_old_poses_and_those_of_another_clock_are_not_sent": (
        "autopilot.max_age_s",
    ),
    "health_wifi::test_a_silence_of_an_hour_stays_an_hour": ("wifi.restart_after_s",),
    "recorder::test_a_full_file_goes_on_in_the_next_without_a_gap": ("recording.max_file_MB",),
    "recorder_folder::test_all_files_together_stay_bounded_and_the_oldest_go": (
        "recording.max_total_MB",
    ),
    "recorder_folder::test_what_cannot_be_recorded_to_is_refused_in_one_line": (
        "recording.min_free_MB",
    ),
}
"""The tests of `test_firmware_*.py` by module and function, and the keys that each sees.

A ground station is found on the interface that `telemetry.discover` names in
`stream/test_stream_discovery.py`.
"""


def test_each_key_of_the_settings_is_seen_and_nothing_else() -> None:
    seen = {key for keys in SEEN_BY.values() for key in keys}
    assert seen | {"telemetry.discover"} == {name for name, _ in fields_of(Settings)}


@pytest.mark.parametrize("test", SEEN_BY)
def test_each_of_these_tests_exists_and_says_its_keys(test: str) -> None:
    module, _, name = test.partition("::")
    source = inspect.getsource(getattr(importlib.import_module(f"test_firmware_{module}"), name))
    for key in SEEN_BY[test]:
        assert key.rpartition(".")[2] in source, f"{test} does not mention {key}"
