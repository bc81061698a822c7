"""Wishes that no session fulfils, as a client sends them, each with a part of its answer."""

REFUSED = [
    (b'{"sensor": "cam01"}', "with sensor is not a request"), (b"{}", "with nothing is not a request"),
    (b'{"sensor": "nowhere", "use": false}', "no sensor 'nowhere'"), (b'{"sensor": "cam01", "use": 1}', "got `int`"),
    (b'{"sensor": "cam01", "sigma": -1}', "from 1e-05 to 10000"), (b'{"sensor": "cam01", "sigma": "x"}', "got `str`"),
    (b'{"sensor": "cam01", "sigma": 1e-300}', "from 1e-05"), (b'{"sensor": "cam01", "sigma": 1e300}', "to 10000"),
    (b'{"sensor": "cam01", "sigma": NaN}', "JSON is malformed"), (b'{"sensor": "a", "sigma": 1e999}', "out of range"),
    (b'{"body": "/etc/passwd"}', "no body of the catalogue"), (b'{"fly": true}', "unknown field `fly`"),
    (b'{"answer": 1, "stop": true}', "unknown field"), (b'{"stop": 1}', "got `int`"), (b"null", "got `null`"),
    (b'{"stop": false}', "with stop is not a request"), (b'{"stop": true, "body": "arm"}', "body, stop is not a"),
    (b"no json", "JSON is malformed"), (b"", "truncated"), (b"[" * 30_000, "has 30000 bytes"),
    (b"[" * 4000, "got `array`"), (b'{"sensor":' + b"[" * 4000, "got `array`"), (b'{"fly":' + b"[" * 4000, "unknown"),
    (b'{"sensor": "%s", "use": true}' % (b"x" * 3000), "length <= 200"), (b'{"body": "%s"}' % (b"x" * 60_000), "bytes"),
    (b"\xff\xfe", "JSON is malformed"),
]  # fmt: skip
