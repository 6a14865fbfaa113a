// @ts-check
/**
 * What the station sends, as types for the other modules; nothing runs here.
 *
 * Times that end in `_ns` are the station's wall clock. They exceed 2^53, so they are exact to a
 * quarter of a microsecond only, which is enough for a page.
 *
 * @typedef {object} Estimate a frame's pose, or why there is none
 * @property {number} sequence
 * @property {number} done_ns
 * @property {string} state INITIALIZING, TRACKING, DEGRADED or LOST
 * @property {number|null} [capture_ns]
 * @property {string} [reason]
 * @property {number[]|null} [position_m] wTc's translation
 * @property {number[]|null} [quaternion_xyzw] wTc's rotation
 * @property {number[]|null} [position_sigma_m] the covariance (3, 3) in world axes, m²
 * @property {number[]|null} [velocity_mps]
 * @property {number|null} [heading_deg] from the map's x axis towards y
 * @property {number|null} [speed_mps]
 * @property {number|null} [height_m]
 * @property {boolean} [relocalized]
 * @property {number} [inliers]
 * @property {number} [expected]
 * @property {number[]} [points_px] u, v by turns
 * @property {Record<string, number>} [stage_ms]
 * @property {string} [map]
 * @property {number} [processed]
 * @property {number} [localized]
 * @property {number} [skipped]
 *
 * @typedef {object} PayloadNote a payload as the intake sees it
 * @property {boolean} alive
 * @property {number} seen_ns
 * @property {boolean} [encrypted]
 * @property {Record<string, number>} [frames]
 * @property {number} [rate_hz]
 * @property {number} [bitrate_kbps]
 * @property {number} [lost_share]
 * @property {{offset_ns: number, uncertainty_ns: number}|null} [clock]
 * @property {number|null} [round_trip_s]
 * @property {Record<string, any>|null} [battery]
 * @property {Record<string, any>|null} [health]
 * @property {Record<string, any>|null} [autopilot]
 * @property {string} [recording]
 * @property {string} [station] another one, which gets its video
 * @property {boolean} [relayed] by that one, which shows it
 *
 * @typedef {object} Event
 * @property {number} time_ns
 * @property {string} source
 * @property {string} level info, warning or alarm
 * @property {string} name
 * @property {string} text
 * @property {string} [payload]
 *
 * @typedef {object} Alarm
 * @property {string} id
 * @property {string} level info, warning or alarm
 * @property {string} payload "-" where it is the station's
 * @property {string} text
 * @property {number} since_ns
 *
 * @typedef {object} RecordingNote
 * @property {string} [resumed]
 * @property {boolean} active
 * @property {string} [file]
 * @property {number} [size_MB]
 * @property {number} [duration_s]
 * @property {number} [dropped]
 * @property {number|null} [free_MB]
 * @property {string} [problem]
 *
 * @typedef {object} Station
 * @property {string} [name]
 * @property {string} [version]
 * @property {number} [uptime_s]
 * @property {string} [map]
 * @property {boolean} [demo]
 * @property {boolean} [loopback] heard on its own computer only
 *
 * @typedef {object} Fleet
 * @property {{name: string, age_s: number, payloads: string[]}[]} stations the others
 * @property {{station: string, map: string, more: number}[]} offers maps of others that grew from this one's
 * @property {Record<string, string>} pins where persons want payloads to fly
 *
 * @typedef {object} PayloadEntry
 * @property {PayloadNote|null} [payload]
 * @property {Estimate|null} [estimate] without its points in a `state`
 * @property {number[][]} [trail] oldest first, metres
 * @property {number[]} [trail_breaks] where a new stretch begins
 * @property {boolean} [alive]
 * @property {Record<string, number|null>} [age_s] of payload, estimate, frame, battery, health, autopilot
 * @property {string[]} [stale] those of `age_s` that are too old to be believed
 * @property {number|null} [state_s] since when the estimate's state stands
 *
 * @typedef {object} Snapshot
 * What `GET /api/state` gives, and parts of it what `state` does
 * @property {Station} [station]
 * @property {object[]} [processes]
 * @property {Record<string, PayloadEntry>} [payloads]
 * @property {RecordingNote|null} [recording]
 * @property {Event[]} [events]
 * @property {Alarm[]} [alarms]
 * @property {Job|null} [job]
 * @property {Fleet|null} [fleet]
 * @property {{at_s: number, playing: boolean, rate: number}} [playback]
 *
 * @typedef {object} VideoHeader
 * @property {string} payload
 * @property {number} sequence
 * @property {number|null} capture_ns
 * @property {number} width_px of the camera's picture, which `points_px` are of
 * @property {number} height_px
 *
 * @typedef {object} RecordingFile
 * @property {string} file
 * @property {number} size_MB
 * @property {number} modified_ns
 * @property {number|null} started_ns null where it was cut
 * @property {number|null} duration_s
 * @property {string[]} maps in which it was localized
 * @property {string} [station] the other one where it lies
 * @property {string} [after] STATION/FILE that it goes on from
 * @property {Record<string, number>|null} lacks frames that were sent and are not in it, by why
 * @property {boolean} active
 *
 * @typedef {object} MapSummary
 * @property {string} name
 * @property {boolean} registered
 * @property {number} landmarks
 * @property {number[]} [extent_m]
 * @property {boolean} floorplan
 *
 * @typedef {object} MapDetails
 * @property {string} name
 * @property {{resolution_m: number, origin: number[], width_px: number, height_px: number, url: string}|null} [floorplan]
 * @property {{min: number[], max: number[]}|null} [bounds] metres
 * @property {Camera|null} [camera] the payloads'
 *
 * @typedef {import("./view_rays.js").Camera} Camera
 *
 * @typedef {object} Step from payload to flight
 * @property {string} name
 * @property {string} title
 * @property {"done"|"ready"|"waiting"} state
 * @property {string} found
 * @property {string} check
 * @property {{text: string, command: string}[]} ways
 * @property {string[]} choices recordings or maps that a job of it takes
 *
 * @typedef {object} Job
 * @property {string} command
 * @property {boolean} running
 * @property {number|null} status
 * @property {string} line the last that it said
 * @property {number|null} share
 * @property {string} page where a person goes on with it
 *
 * @typedef {object} Answer of a command
 * @property {boolean} done
 * @property {string} reason
 * @property {Record<string, number|string>} [values]
 *
 * @typedef {object} Shared what a panel is made of
 * @property {import("./store.js").Store} store
 * @property {import("./loop.js").Loop} loop
 * @property {import("./theme.js").Theme} theme
 * @property {import("./video.js").Video} video
 */
export {};
