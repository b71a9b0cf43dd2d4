//! Dashboard and alerts of `deploy/`: errors in queries and layout are detected. tests/telemetry/metrics.rs checks
//! that the queried metrics exist.

use crate::metrics_support;
use crate::tools;

use std::collections::BTreeSet;
use std::path::Path;
use std::process::Command;

use metrics_support::Scrape;
use metrics_support::queries::{FILES, faults, path};
use serde_json::Value;

const EXPOSED: &str = "# HELP molmesh_queue_depth x\n# TYPE molmesh_queue_depth gauge\nmolmesh_queue_depth 1\n\
                       # HELP molmesh_cache_requests_total x\n# TYPE molmesh_cache_requests_total counter\n\
                       molmesh_cache_requests_total{tier=\"store\",result=\"hit\"} 1\n";

#[test]
fn every_query_parses() {
    let Some(files) = tools::queries(&FILES.map(path)) else { return };
    for (file, queries) in FILES.iter().zip(files) {
        assert_eq!(queries.error, None, "{file}");
        assert!(queries.expressions.len() > 10, "{file}");
        for expression in queries.expressions {
            assert_eq!(expression.error, None, "{file}: {}", expression.place);
            assert!(!expression.selectors.is_empty(), "{file}: {}: no selectors", expression.place);
        }
    }
}

#[test]
fn wrong_queries_are_detected() {
    let folder = tempfile::tempdir().unwrap();
    let rule = |n: usize, expression: &str, says: &str| {
        let path = folder.path().join(format!("{n}.yaml"));
        let quoted = Value::from(expression);
        let text =
            format!("groups: [{{name: g, rules: [{{alert: A, expr: {quoted}, annotations: {{summary: '{says}'}}}}]}}]");
        std::fs::write(&path, text).unwrap();
        path
    };
    let cases = [
        ("molmesh_queue_depth > 3", "{{ $labels.instance }}", None),
        ("sum by (tier) (rate(molmesh_cache_requests_total{result=\"hit\"}[5m]))", "{{ $labels.tier }}", None),
        ("up == 0", "", None),
        ("sum(molmesh_queue_depth", "", Some("unclosed")),
        ("rate(molmesh_queue_depth)", "", Some("matrix")),
        ("molmesh_queue_deep > 3", "", Some("molmesh_queue_deep is not exposed")),
        ("molmesh_queue_depth{device=\"0\"}", "", Some("no label device")),
        ("sum by (device) (molmesh_queue_depth)", "", Some("no label device")),
        ("molmesh_queue_depth / on (device) molmesh_queue_depth", "", Some("no label device")),
        ("molmesh_queue_depth", "{{ $labels.device }}", Some("no label device")),
        ("molmesh_cache_requests_total{result=\"hot\"}", "", Some("never hot")),
        ("molmesh_queue_depth{job=\"$other\"}", "", Some("unknown variable")),
    ];
    let paths: Vec<_> = cases.iter().enumerate().map(|(n, (text, says, _))| rule(n, text, says)).collect();
    let Some(files) = tools::queries(&paths) else { return };
    for ((text, _, expected), queries) in cases.iter().zip(&files) {
        let found = faults(queries, &Scrape::of(EXPOSED));
        match expected {
            None => assert_eq!(found, Vec::<String>::new(), "{text}"),
            Some(words) => assert!(found.iter().any(|fault| fault.contains(words)), "{text}: {found:?}"),
        }
    }
    let broken = folder.path().join("broken.json");
    std::fs::write(&broken, "{\"panels\": 3}").unwrap();
    assert!(tools::queries(&[broken]).unwrap()[0].error.is_some());
}

#[test]
fn dashboard_panels_have_titles_and_do_not_overlap() {
    let text = std::fs::read_to_string(path("deploy/grafana.json")).unwrap();
    let dashboard: Value = serde_json::from_str(&text).unwrap();
    let panels = dashboard["panels"].as_array().unwrap();
    let mut ids = BTreeSet::new();
    let mut occupied = BTreeSet::new();
    for panel in panels {
        assert!(ids.insert(panel["id"].as_u64().unwrap()), "{panel}");
        assert!(panel["title"].as_str().is_some_and(|title| !title.is_empty()), "{panel}");
        let side = |name: &str| panel["gridPos"][name].as_u64().unwrap();
        assert!(side("x") + side("w") <= 24, "{panel}");
        for y in side("y")..side("y") + side("h") {
            for x in side("x")..side("x") + side("w") {
                assert!(occupied.insert((x, y)), "{panel} overlaps another panel");
            }
        }
    }
}

fn run(tool: &Path, arguments: &[&str]) -> (bool, String) {
    let output = Command::new(tool).args(arguments).output().unwrap();
    let text = [output.stdout, output.stderr].concat();
    (output.status.success(), String::from_utf8_lossy(&text).into_owned())
}

#[test]
fn promtool_accepts_the_rules_and_they_fire_in_time() {
    let Some(promtool) = tools::promtool() else { return };
    let rules = path("deploy/alerts.yaml");
    let (good, printed) = run(&promtool, &["check", "rules", &rules.to_string_lossy()]);
    assert!(good && printed.contains("rules found"), "{printed}");
    let folder = tempfile::tempdir().unwrap();
    let tests = std::fs::read_to_string(path("tests/tools/alerts_test.yaml")).unwrap();
    let with = |name: &str, rules: &str| {
        let (rule_file, test_file) = (folder.path().join(format!("{name}.rules")), folder.path().join(name));
        std::fs::write(&rule_file, rules).unwrap();
        std::fs::write(&test_file, tests.replace("RULES", &rule_file.to_string_lossy())).unwrap();
        run(&promtool, &["test", "rules", &test_file.to_string_lossy()])
    };
    let text = std::fs::read_to_string(&rules).unwrap();
    let (good, printed) = with("good.yaml", &text);
    assert!(good, "{printed}");
    // Control: rules that fire too late, and invalid rules.
    let (good, printed) = with("late.yaml", &text.replace("for: 2m", "for: 20m"));
    assert!(!good && printed.contains("MolmeshDown"), "{printed}");
    let broken = folder.path().join("broken.yaml");
    std::fs::write(&broken, text.replace("== 0", "=== 0")).unwrap();
    assert!(!run(&promtool, &["check", "rules", &broken.to_string_lossy()]).0);
}

#[test]
fn promtool_accepts_the_exposition() {
    let Some(promtool) = tools::promtool() else { return };
    let lint = |text: &str| {
        use std::io::Write as _;
        use std::process::Stdio;
        let mut child = Command::new(&promtool)
            .args(["check", "metrics"])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        child.stdin.take().unwrap().write_all(text.as_bytes()).unwrap();
        let output = child.wait_with_output().unwrap();
        (output.status.success(), String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned())
    };
    let text = molmesh::telemetry::recorder().unwrap().render();
    let (good, printed) = lint(&text);
    assert!(good && printed.is_empty(), "{printed}");
    let (good, printed) = lint("# HELP x_total x\n# TYPE x_total gauge\nx_total 1\n");
    assert!(!good, "{printed}");
}
