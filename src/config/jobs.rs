//! Settings of the worker pool: concurrency, queue and time limits.

section! {
    /// Worker pool.
    JobsConfig;
    /// Number of concurrent jobs of each lane: short requests, long requests, asynchronous jobs. Default 2: the backend
    /// uses all cores for one job, and a second one fills them while the first reads its file or measures its mesh.
    /// At least 16 for each GPU.
    workers: usize = 2;
    /// Number of queued requests in each lane, short and long. Default 64: at a typical 0.1 s per job on two workers
    /// the last one waits three seconds; a longer queue would only delay refusals. Further requests get a 503 with an
    /// estimated `Retry-After`.
    queue: usize = 64;
    /// Number of concurrent requests for meshes, from the submission of the job to the last byte of the response.
    /// Fixed: each one holds a thread while its mesh is written, and some threads must stay free to read files.
    #[serde(skip)]
    deliveries: usize = 256;
    /// Time from acceptance to the finished mesh, ms, time in the queue included; also the longest wait for `Prefer:
    /// wait=`. Default 60,000: proxies commonly cut an exchange after a minute.
    deadline_ms: u64 = 60_000;
    /// Time from the claim of an asynchronous job by a worker to its result, ms. Default 3,600,000: no connection is
    /// held for it.
    batch_deadline_ms: u64 = 3_600_000;
    /// Maximum number of attempts to run an asynchronous job. Default 3: a job that crashed the process that often is
    /// assumed to crash it again.
    attempts: u32 = 3;
    /// Time for which an asynchronous job retries to store its mesh, ms. Fixed: longer than a restart of the store
    /// takes. After that the mesh is computed again, for at most `attempts` attempts.
    #[serde(skip)]
    save_retry_ms: u64 = 60_000;
    /// Number of results of synchronous requests that are stored concurrently. Fixed: more would compete with meshing,
    /// as would more than one while jobs wait for a worker; a result that is not stored is computed again for the next
    /// request.
    #[serde(skip)]
    concurrent_saves: usize = 4;
    /// Number of asynchronous jobs on record, open and ended. Fixed: the records take 400 MB of disk in blocks of 4
    /// KiB, and listing them at the start takes seconds. At the limit, the record of the ended job that was not used
    /// for the longest time is removed; if all jobs are open, new ones get a 503.
    #[serde(skip)]
    records: usize = 100_000;
    /// Number of asynchronous jobs of one client on record. Default 2,500, a quarter of the default of `broker.queue`:
    /// one client can neither displace the records of the others nor fill the queue. At the limit, the record of its
    /// ended job that was not used for the longest time is removed; if all its jobs are open, new ones get a 503. Jobs
    /// run in the order of their acceptance, so this also bounds the number of jobs of one client for which the others
    /// wait.
    records_per_client: usize = 2500;
}
