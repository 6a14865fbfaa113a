"""The process that receives, decodes and records all payloads, and never waits for anyone.

`process` puts it together; `roster` says whose a stream is, `payloads` what is known of each
payload, `recording` what stays on the disk, `poses` what goes back.
"""
