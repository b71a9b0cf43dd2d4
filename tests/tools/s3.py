"""Runs an in-memory S3 service for the tests of the store.

Prints one line of JSON when it is ready and ends at the end of standard input. The bucket is `meshes`. With
`--guarded`, it accepts only the printed credentials. After the line `away` it drops every connection; after `back` it
serves again. It echoes each line. With `--unconditional`, it ignores the conditions of writes, as services without
conditional writes do; with `--unlisted`, it does not list multipart uploads.
"""

import json
import logging
import socket
import sys
import urllib.parse

import boto3
from moto import settings
from moto.server import ThreadedMotoServer

logging.getLogger("werkzeug").setLevel(logging.ERROR)
server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
server.start()
host, port = server.get_host_and_port()
endpoint = f"http://{host}:{port}"


def client(service):
    return boto3.client(
        service,
        endpoint_url=endpoint,
        region_name="us-east-1",
        aws_access_key_id="setup",
        aws_secret_access_key="setup",
    )


client("s3").create_bucket(Bucket="meshes")
key = {"AccessKeyId": "any", "SecretAccessKey": "any"}
if "--guarded" in sys.argv:
    iam = client("iam")
    iam.create_user(UserName="molmesh")
    everything = {"Version": "2012-10-17", "Statement": [{"Effect": "Allow", "Action": "*", "Resource": "*"}]}
    iam.put_user_policy(UserName="molmesh", PolicyName="all", PolicyDocument=json.dumps(everything))
    key = iam.create_access_key(UserName="molmesh")["AccessKey"]
    settings.INITIAL_NO_AUTH_ACTION_COUNT = 0  # all requests from here on need credentials


class Gate:
    """WSGI application that can be made unavailable while it keeps its port."""

    def __init__(self, app):
        self.app, self.away = app, False

    def __call__(self, environ, start_response):
        if self.away:
            environ["werkzeug.socket"].shutdown(socket.SHUT_RDWR)
            raise ConnectionAbortedError
        if "--unconditional" in sys.argv and environ["REQUEST_METHOD"] == "PUT":
            environ.pop("HTTP_IF_NONE_MATCH", None)
        query = urllib.parse.parse_qs(environ["QUERY_STRING"], keep_blank_values=True)
        if "--unlisted" in sys.argv and environ["REQUEST_METHOD"] == "GET" and "uploads" in query:
            start_response("501 Not Implemented", [("content-length", "0")])
            return []
        return self.app(environ, start_response)


gate = server._server.app = Gate(server._server.app)
answer = {"endpoint": endpoint, "id": key["AccessKeyId"], "secret": key["SecretAccessKey"]}
print(json.dumps(answer), flush=True)
for line in sys.stdin:
    gate.away = line.strip() == "away"
    print(line.strip(), flush=True)
server.stop()
