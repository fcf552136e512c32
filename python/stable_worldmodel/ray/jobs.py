"""Runs on another cluster: a job whose driver is a node of that cluster."""

from __future__ import annotations

import asyncio
import hashlib
import json
import os
import shlex
import sys
import time
from typing import Any

from ray.job_submission import JobStatus, JobSubmissionClient

from .._process import module_command
from .driver import begin
from .folder import Folder

__all__ = ["submit"]


def submit(request: dict[str, Any], address: str) -> int:
    """Writes the request to the folder of the run, submits a job that runs it, and prints its log. Returns an exit code.

    If the run has a job already, follows that one.

    Args:
        request: The request.
        address: The URL of the dashboard.
    """
    for name in ("RAY_ADDRESS", "RAY_API_SERVER_ADDRESS"):
        os.environ.pop(name, None)  # Ray would prefer them to the address
    try:
        client = JobSubmissionClient(address)
    except Exception as error:
        raise RuntimeError(f"the cluster at {address} does not answer ({error}); give the port of its dashboard") from None
    begin(Folder(request["folder"]), request)
    prefix = f"swm-{hashlib.sha256(request['folder'].encode()).hexdigest()[:12]}"
    running = [job.submission_id for job in client.list_jobs() if _is_of(job, prefix)]
    name = running[0] if running else f"{prefix}-{int(time.time())}"
    if not running:
        # `begin` has written this request, or found it there.
        command = shlex.join(module_command("stable_worldmodel.ray", request["folder"], "--trust", "--json", python="python"))
        client.submit_job(entrypoint=command, submission_id=name, metadata={"kind": request["kind"], "run": request["folder"]})
    print(f"ray: job {name} at {address}", file=sys.stderr, flush=True)
    try:
        asyncio.run(_follow(client, name))
    except KeyboardInterrupt:
        client.stop_job(name)
        raise
    status = client.get_job_status(name)
    if status == JobStatus.SUCCEEDED:
        return 0
    if status == JobStatus.FAILED:
        print(f"error: the job {name} failed: {client.get_job_info(name).message}", file=sys.stderr)
    return 130 if status == JobStatus.STOPPED else 1


def _is_of(job: Any, prefix: str) -> bool:
    """Whether a job is an unfinished one of a run."""
    return str(job.submission_id).startswith(prefix) and not job.status.is_terminal()


async def _follow(client: JobSubmissionClient, name: str) -> None:
    """Prints the log of a job until it ends: JSON on standard output, the rest on standard error."""
    async for lines in client.tail_job_logs(name):
        for line in lines.splitlines(keepends=True):
            print(line, end="", flush=True, file=sys.stdout if _is_json(line) else sys.stderr)


def _is_json(line: str) -> bool:
    try:
        return isinstance(json.loads(line), dict)
    except ValueError:
        return False
