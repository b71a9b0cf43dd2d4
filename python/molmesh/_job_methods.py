"""Documented methods of jobs and batches. The operations are in ``_session``."""

from ._messages import Output, batch_path, check_folder


class Submitted:
    """Job or batch of a service. `_client` performs its operations."""

    def __init__(self, client, id):
        self._client, self._id = client, id

    @property
    def id(self):
        """Id for ``Client.job()`` or ``Client.batch()``."""
        return self._id

    def __repr__(self):
        return f"{type(self).__name__}({self.id!r})"


class JobMethods(Submitted):
    """Methods of a job."""

    def status(self):
        """Returns the state of the job.

        Returns
        -------
        dict
            Status document of the service: ``status`` (``accepted``, ``running``, ``successful``, ``failed`` or
            ``dismissed``), ``fraction``, ``stage``, ``problem`` and more.
        """
        return self._client._run(self._client._session.job(self.id))

    def wait(self, timeout=None):
        """Waits until the job has ended.

        Parameters
        ----------
        timeout : float, optional
            Longest time to wait in s; without it, until the service ends the job.

        Returns
        -------
        dict
            The last state, as ``status()`` returns it.

        Raises
        ------
        TimeoutError
            If the job has not ended by then. It continues to run.
        """
        return self._client._run(self._client._session.wait(self.id, timeout))

    def result(self, timeout=None, *, save=None):
        """Returns the mesh or picture, after the job has ended.

        Parameters
        ----------
        timeout : float, optional
            Longest time to wait for the end in s.
        save : str or os.PathLike, optional
            File to write instead of returning the content.

        Returns
        -------
        bytes or pathlib.Path
            The content, or the path ``save``.

        Raises
        ------
        molmesh.Error
            If the job failed, with its problem; of the type ``job-dismissed`` if it was cancelled, and ``result-gone``
            if the service has removed the result.
        TimeoutError
            If the job has not ended in time.
        """
        return self._client._run(self._client._session.saved_result(self.id, timeout, Output(save)))

    def cancel(self):
        """Cancels the job.

        Returns
        -------
        dict
            The last state, as ``status()`` returns it.

        Raises
        ------
        molmesh.Error
            Of the type ``job-ended``, if the job succeeded or failed before.
        """
        return self._client._run(self._client._session.cancel(self.id))


class BatchMethods(Submitted):
    """Methods of a batch."""

    def status(self):
        """Returns the state of the batch.

        Returns
        -------
        dict
            Document of the service: ``status``, ``progress`` in per cent, ``counts`` of files in each state, and
            ``members``, the first 100 files.
        """
        return self._client._run(self._client._session.batch(self.id))

    def files(self):
        """Lists the files of the batch.

        Returns
        -------
        iterator of dict
            ``file``, its ``status``, its ``jobs`` and its ``problem``, in the order of the request; an asynchronous
            iterator in ``AsyncBatch``.
        """
        return self._client._iterate(self._client._session.list_items(batch_path(self.id), "members", []))

    def wait(self, timeout=None, *, progress=None):
        """Waits until all files have ended.

        Parameters
        ----------
        timeout : float, optional
            Longest time to wait in s; without it, until the service ends the batch.
        progress : callable, optional
            Called about once a second with the state, as ``status()`` returns it.

        Returns
        -------
        dict
            The last state.

        Raises
        ------
        TimeoutError
            If the batch has not ended by then. It continues to run.
        """
        return self._client._run(self._client._session.wait_batch(self.id, timeout, progress))

    def results(self):
        """Yields the results in the order of the files, each as soon as it and those before it are computed.

        After a lost connection, waits for the end of the batch and gets the rest.

        Returns
        -------
        iterator of (str, bytes)
            Name and content of each file; an asynchronous iterator in ``AsyncBatch``. The last one is
            ``summary.jsonl``, with a JSON line for each file of the request: the results, or the problem.
        """
        return self._client._iterate(self._client._session.batch_results(self.id))

    def save(self, folder):
        """Writes the results into a folder, in the order of ``results()``.

        Existing files of the same names are replaced. After an error, the folder has complete files only. Needs Python
        3.10.12, 3.11.4 or later, whose ``tarfile`` rejects names that lead out of a folder.

        Parameters
        ----------
        folder : str or os.PathLike
            Existing folder.

        Returns
        -------
        list of (str, pathlib.Path)
            Name and path of each file, as in ``results()``.

        Raises
        ------
        tarfile.FilterError
            If a name leads out of the folder.
        """
        check_folder(folder, "save")
        return self._client._collect(self._client._session.batch_results(self.id, folder))

    def cancel(self):
        """Cancels the jobs of the batch that have not ended.

        Returns
        -------
        dict
            The last state, as ``status()`` returns it.

        Raises
        ------
        molmesh.Error
            Of the type ``job-ended``, if no job was left to cancel.
        """
        return self._client._run(self._client._session.cancel_batch(self.id))
