//! The fields that tell clients of their quota: `RateLimit-Policy` and `RateLimit`, structured fields after
//! draft-ietf-httpapi-ratelimit-headers-11.
//!
//! Policies are `requests`, `work` and `concurrency`. The draft has no unit for work, so ours has a name of its own.

use super::account::{Quota, Standing};

/// The unit of work: seconds that workers spend.
const WORK_UNIT: &str = "molmesh-work-seconds";

/// The value of `RateLimit-Policy`: what there is; none where nothing is limited.
#[must_use]
pub fn policies(quota: &Quota) -> Option<String> {
    let window = quota.window().as_secs();
    let requests = quota.requests.map(|q| format!("\"requests\";q={q};w={window}"));
    let work = quota.work_s.map(|q| format!("\"work\";q={q};qu=\"{WORK_UNIT}\";w={window}"));
    let concurrent = quota.concurrent.map(|q| format!("\"concurrency\";q={q};qu=\"concurrent-requests\""));
    list([requests, work, concurrent])
}

/// The value of `RateLimit`: what of it is left, and for how many seconds.
#[must_use]
pub fn limits(quota: &Quota, standing: &Standing) -> Option<String> {
    let left = whole_seconds(standing.left.as_millis());
    let requests = quota.requests.map(|q| format!("\"requests\";r={};t={left}", q.saturating_sub(standing.requests)));
    // Of what is left only whole seconds count.
    let spent = whole_seconds(standing.work.as_millis());
    let work = quota.work_s.map(|q| format!("\"work\";r={};t={left}", q.saturating_sub(spent)));
    let concurrent = quota.concurrent.map(|q| format!("\"concurrency\";r={}", q.saturating_sub(standing.running)));
    list([requests, work, concurrent])
}

/// Milliseconds in seconds, rounded up.
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
    fn the_fields_are_as_the_draft_writes_them() {
        let quota = Quota { requests: Some(100), work_s: Some(600), concurrent: Some(4), window_s: 60 };
        assert_eq!(
            policies(&quota).unwrap(),
            "\"requests\";q=100;w=60, \"work\";q=600;qu=\"molmesh-work-seconds\";w=60, \
             \"concurrency\";q=4;qu=\"concurrent-requests\""
        );
        let standing = Standing {
            requests: 50,
            work: Duration::from_millis(1001),
            running: 1,
            left: Duration::from_millis(29_001),
        };
        let field = limits(&quota, &standing).unwrap();
        assert_eq!(field, "\"requests\";r=50;t=30, \"work\";r=598;t=30, \"concurrency\";r=3");
        let beyond =
            Standing { requests: 1000, work: Duration::from_hours(1), running: 9, left: Duration::from_secs(1) };
        let field = limits(&quota, &beyond).unwrap();
        assert_eq!(field, "\"requests\";r=0;t=1, \"work\";r=0;t=1, \"concurrency\";r=0");
        let only = Quota { requests: Some(1), ..Quota::default() };
        assert_eq!(policies(&only).unwrap(), "\"requests\";q=1;w=1");
        assert_eq!((policies(&Quota::default()), limits(&Quota::default(), &standing)), (None, None));
    }
}
