//! Header fields `RateLimit-Policy` and `RateLimit`, structured fields of draft-ietf-httpapi-ratelimit-headers-11.
//!
//! The policies are `requests`, `work` and `concurrency`. The draft defines no unit of computing time, so `work` has
//! its own.

use super::account::{Quota, QuotaUsage};

/// Quota unit of `work`: seconds of computing time.
const WORK_UNIT: &str = "molmesh-work-seconds";

/// Returns the value of `RateLimit-Policy`, the limits of `quota`, or `None` if nothing is limited.
pub(crate) fn rate_limit_policy(quota: &Quota) -> Option<String> {
    let window = quota.window().as_secs();
    let requests = quota.requests.map(|q| format!("\"requests\";q={q};w={window}"));
    let work = quota.work_s.map(|q| format!("\"work\";q={q};qu=\"{WORK_UNIT}\";w={window}"));
    let concurrent = quota.concurrent.map(|q| format!("\"concurrency\";q={q};qu=\"concurrent-requests\""));
    list([requests, work, concurrent])
}

/// Returns the value of `RateLimit`, the remaining quota and the seconds until the next window, or `None` if nothing is
/// limited.
pub(crate) fn rate_limit(quota: &Quota, usage: &QuotaUsage) -> Option<String> {
    let left = whole_seconds(usage.left.as_millis());
    let requests = quota.requests.map(|q| format!("\"requests\";r={};t={left}", q.saturating_sub(usage.requests)));
    // Rounding the used time up rounds the remaining time down.
    let spent = whole_seconds(usage.work.as_millis());
    let work = quota.work_s.map(|q| format!("\"work\";r={};t={left}", q.saturating_sub(spent)));
    let concurrent = quota.concurrent.map(|q| format!("\"concurrency\";r={}", q.saturating_sub(usage.running)));
    list([requests, work, concurrent])
}

/// Converts milliseconds to seconds, rounded up.
fn whole_seconds(ms: u128) -> u64 {
    u64::try_from(ms.div_ceil(1000)).unwrap_or(u64::MAX)
}

fn list(items: [Option<String>; 3]) -> Option<String> {
    let items: Vec<String> = items.into_iter().flatten().collect();
    (!items.is_empty()).then(|| items.join(", "))
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn fields_follow_the_draft() {
        let quota = Quota { requests: Some(100), work_s: Some(600), concurrent: Some(4), window_s: 60 };
        assert_eq!(
            rate_limit_policy(&quota).unwrap(),
            "\"requests\";q=100;w=60, \"work\";q=600;qu=\"molmesh-work-seconds\";w=60, \
             \"concurrency\";q=4;qu=\"concurrent-requests\""
        );
        let usage = QuotaUsage {
            requests: 50,
            work: Duration::from_millis(1001),
            running: 1,
            left: Duration::from_millis(29_001),
        };
        let field = rate_limit(&quota, &usage).unwrap();
        assert_eq!(field, "\"requests\";r=50;t=30, \"work\";r=598;t=30, \"concurrency\";r=3");
        let beyond =
            QuotaUsage { requests: 1000, work: Duration::from_hours(1), running: 9, left: Duration::from_secs(1) };
        let field = rate_limit(&quota, &beyond).unwrap();
        assert_eq!(field, "\"requests\";r=0;t=1, \"work\";r=0;t=1, \"concurrency\";r=0");
        let only = Quota { requests: Some(1), ..Quota::default() };
        assert_eq!(rate_limit_policy(&only).unwrap(), "\"requests\";q=1;w=1");
        assert_eq!((rate_limit_policy(&Quota::default()), rate_limit(&Quota::default(), &usage)), (None, None));
    }
}
