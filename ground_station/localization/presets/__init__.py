"""The presets that ship: settings files of the localizer."""
