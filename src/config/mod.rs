//! Configuration of the service.
