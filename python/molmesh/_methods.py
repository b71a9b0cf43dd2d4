"""Documented methods of the clients. The operations are in ``_session``."""

import os
import pathlib

from ._messages import Output, check_folder
from ._session import Session


class ClientMethods:
    """Operations of a client. ``_run`` returns their result, or a coroutine that does; ``_iterate`` an iterator."""

    def __init__(self, url, key=None, *, timeout=300.0):
        self._session = Session(url, key, timeout)
        self._http = self._connect()

    def __repr__(self):
        return f"{type(self).__name__}({self._session.url!r})"

    def capabilities(self):
        """Returns the formats, parameters, limits and devices of the service.

        Returns
        -------
        dict
            The document of ``/v1/capabilities``; its ``limits`` have the number of ``workers``.
        """
        return self._run(self._session.capabilities())

    def upload(self, file):
        """Stores a structure in the service, for several meshes.

        Parameters
        ----------
        file : str, os.PathLike or bytes
            Structure file or its content.

        Returns
        -------
        str
            The digest, which other operations take instead of a file. The service keeps the structure for some days
            after its last use.
        """
        return self._run(self._session.upload(file))

    def mesh(self, source, *, format=None, save=None, map=None, **parameters):
        """Meshes a structure.

        A mesh that takes long becomes an asynchronous job of the service, and the call waits for its end. After a
        timeout, the job continues, and the same call gets it again.

        Parameters
        ----------
        source : str, os.PathLike or bytes
            Structure file or its content, the digest of an uploaded structure, or the id of an archive entry, such as
            ``"4pti"`` or ``"pdb_00004pti"``. A ``pathlib.Path`` is always a file.
        format : str, optional
            Format of the mesh. Default: the extension of ``save``, or ``"glb"``.
        save : str or os.PathLike, optional
            File to write instead of returning the mesh.
        map : str, os.PathLike or bytes, optional
            CCP4, MRC or OpenDX map, for ``color="map"`` and a structure file.
        **parameters
            Parameters of the service, described in ``molmesh.PARAMETERS``, with its defaults: ``atom_ids`` is false.

        Returns
        -------
        bytes or pathlib.Path
            The mesh, or the path ``save``.

        Raises
        ------
        molmesh.Error
            If the service answers with a problem. It has the type and the fields of that of ``surface()``.
        ValueError
            If the service rejects a parameter.
        ConnectionError
            If the service cannot be reached.
        TimeoutError
            If the service does not answer, or the mesh is not done, within the ``timeout`` of the client.
        OSError
            If a file cannot be opened or written.

        Examples
        --------
        >>> client = molmesh.Client("http://127.0.0.1:8080")
        >>> client.mesh("samples/4pti.pdb", surface="ses")[:4]
        b'glTF'
        """
        if format is None:
            format = "glb" if save is None else _extension(save)
        return self._run(self._session.mesh(source, map, Output(save), {"format": format, **parameters}))

    def picture(self, source, *, save=None, map=None, **parameters):
        """Draws the mesh of a structure.

        Parameters
        ----------
        source, save, map, **parameters
            As in ``mesh()``, with the parameters of a picture, such as ``width`` and ``view``.

        Returns
        -------
        bytes or pathlib.Path
            A PNG file, or the path ``save``.
        """
        return self.mesh(source, format="png", save=save, map=map, **parameters)

    def report(self, source, *, map=None, **parameters):
        """Meshes a structure and returns the report only.

        Parameters
        ----------
        source, map, **parameters
            As in ``mesh()``.

        Returns
        -------
        dict
            Area, volume, components, atoms, grid and times, as in ``Mesh.report``.
        """
        return self._run(self._session.describe("/v1/report", source, map, parameters))

    def estimate(self, source, *, map=None, **parameters):
        """Estimates size and time of a mesh, without making it.

        Parameters
        ----------
        source, map, **parameters
            As in ``mesh()``.

        Returns
        -------
        dict
            ``accepted``, ``problem``, ``triangles``, ``mesh_bytes``, ``seconds`` and more.
        """
        return self._run(self._session.describe("/v1/estimate", source, map, parameters))

    def areas(self, source, **parameters):
        """Computes exact areas, without a mesh.

        Parameters
        ----------
        source
            As in ``mesh()``. A file is sent with the request and not stored.
        **parameters
            Those of ``molmesh.areas()``.

        Returns
        -------
        dict of str to numpy.ndarray
            The columns of ``molmesh.areas()``.

        Examples
        --------
        >>> client = molmesh.Client("http://127.0.0.1:8080")
        >>> areas = client.areas("samples/4pti.pdb", surface="sas", by="chain")
        >>> areas["chain"][0], round(float(areas["area"][0]), 1)
        (np.str_('A'), 3977.7)
        """
        return self._run(self._session.areas(source, parameters))

    def submit(self, source, *, format="glb", map=None, **parameters):
        """Starts an asynchronous job, which survives a restart of the service.

        The same call, even of another process, returns the same job as long as the service keeps it, unless the job
        was cancelled or failed because of the service.

        Parameters
        ----------
        source, format, map, **parameters
            As in ``mesh()``.

        Returns
        -------
        Job or AsyncJob
            The job.
        """

        def steps():
            return self.job((yield from self._session.submit(source, map, {"format": format, **parameters})))

        return self._run(steps())

    def job(self, id):
        """Returns the job with an id that ``submit()`` gave, without a request.

        Parameters
        ----------
        id : str
            Id of the job.

        Returns
        -------
        Job or AsyncJob
            The job.
        """
        return self._job_type(self, id)

    def jobs(self, state=None):
        """Lists the asynchronous jobs of the key's group or, without a key, of the client's address.

        Parameters
        ----------
        state : str, optional
            ``accepted``, ``running``, ``successful``, ``failed`` or ``dismissed``; without it, all jobs.

        Returns
        -------
        iterator of dict
            Their states, as ``Job.status()`` returns them, in no particular order; an asynchronous iterator in
            ``AsyncClient``.

        Examples
        --------
        >>> client = molmesh.Client("http://127.0.0.1:8080")
        >>> job = client.submit("samples/4pti.pdb", resolution=0.9)
        >>> job.id in [state["jobID"] for state in client.jobs()]
        True
        """
        return self._iterate(self._session.list_items("/v1/jobs", "jobs", [] if state is None else [("state", state)]))

    def submit_batch(self, files, *, outputs="glb", **parameters):
        """Starts a batch: one request for many files with one set of parameters.

        The same call, even of another process, returns the same batch as long as the service keeps it, unless a job
        was cancelled or one of the first 100 files failed because of the service. After a timeout, the same call gets
        the batch, which the service accepts as a whole or not at all.

        Parameters
        ----------
        files : iterable or dict
            Paths of structure files or their contents, or ids of archive entries, but not both. Results have the name
            of their file without its folder; a dictionary gives other names, such as ``{"native/4pti.pdb": path}``.
        outputs : str or list of str, optional
            Formats of meshes and pictures, and ``"areas"`` for a table of exact areas.
        **parameters
            As in ``mesh()`` and ``areas()``. Each applies to the outputs that have it.

        Returns
        -------
        Batch or AsyncBatch
            The batch.

        Raises
        ------
        molmesh.Error
            If the service rejects the whole batch. The problem of a file that cannot be used is in ``Batch.files()``
            instead, and the other files are processed.
        """
        _check_several(files)

        def steps():
            return self.batch((yield from self._session.submit_batch(files, {"outputs": outputs, **parameters})))

        return self._run(steps())

    def batch(self, id):
        """Returns the batch with an id that ``submit_batch()`` gave, without a request.

        Parameters
        ----------
        id : str
            Id of the batch.

        Returns
        -------
        Batch or AsyncBatch
            The batch.
        """
        return self._batch_type(self, id)

    def map(self, files, *, format="glb", save=None, concurrency=None, progress=False, **parameters):
        """Meshes many structures with asynchronous jobs, enough at once to keep all workers of the service busy.

        The results are in the order of their completion. An error of one file does not stop the others. Requests are
        repeated while the service restarts. A program that ends early and calls ``map`` again with the same files and
        parameters gets the jobs that it has started, as long as the service keeps them.

        Parameters
        ----------
        files : iterable
            Sources as in ``mesh()``. They are taken as workers become free.
        format : str, optional
            Format of the meshes; ``"png"`` for pictures.
        save : str or os.PathLike, optional
            Existing folder for files with the names of the sources and the extension of the format.
        concurrency : int, optional
            Number of files at once. Default: twice the number of workers of the service, as half of them are being
            sent or received.
        progress : bool, optional
            Shows a progress bar; needs the package tqdm.
        **parameters
            As in ``mesh()``.

        Returns
        -------
        iterator of MapResult
            ``source``, ``content`` and ``error`` of each file; an asynchronous iterator in ``AsyncClient``.

        Examples
        --------
        >>> client = molmesh.Client("http://127.0.0.1:8080")
        >>> for result in client.map(["samples/4pti.pdb", "no.pdb"], resolution=1):
        ...     print(result.source, result.error or result.content[:4])  # doctest: +SKIP
        samples/4pti.pdb b'glTF'
        no.pdb [Errno 2] No such file or directory: 'no.pdb'
        """
        _check_several(files)
        if save is not None:
            check_folder(save, "map")
        if concurrency is not None and concurrency < 1:
            raise ValueError(f"concurrency is {concurrency}, expected at least 1")
        results = self._each(self._session.outcomes(files, save, {"format": format, **parameters}), concurrency)
        if not progress:
            return results
        try:
            from tqdm.auto import tqdm
        except ImportError:
            raise ImportError("progress=True needs the package tqdm: pip install tqdm") from None
        return tqdm(results, total=len(files) if hasattr(files, "__len__") else None, unit="file")


def _check_several(files):
    """Rejects a single file."""
    if isinstance(files, (str, bytes, bytearray, memoryview, os.PathLike)):
        raise TypeError(f"files is one {type(files).__name__}, expected several files, such as a list")


def _extension(path):
    """Returns the format that the extension of a path names."""
    extension = pathlib.Path(path).suffix.lstrip(".")
    if not extension:
        raise ValueError(f"`{path}` has no extension; expected one of a format, or format=")
    return extension
