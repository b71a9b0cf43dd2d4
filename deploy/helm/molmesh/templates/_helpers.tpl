{{/* Labels of an object of a component. */}}
{{- define "molmesh.labels" -}}
app.kubernetes.io/name: molmesh
app.kubernetes.io/instance: {{ .root.Release.Name }}
app.kubernetes.io/component: {{ .component }}
{{- end }}

{{/* Pod template of a component. `tag` is that of the image, `role` that of the node. */}}
{{- define "molmesh.pod" -}}
metadata:
  labels:
    {{- include "molmesh.labels" . | nindent 4 }}
  annotations:
    prometheus.io/scrape: "true"
    prometheus.io/port: "9090"
    # A change of the configuration starts new pods.
    checksum/configuration: {{ include (print .root.Template.BasePath "/configuration.yaml") .root | sha256sum }}
spec:
  automountServiceAccountToken: false
  enableServiceLinks: false # would add environment variables such as MOLMESH_PORT
  securityContext:
    runAsNonRoot: true
    runAsUser: 65532
    runAsGroup: 65532
    fsGroup: 65532
    seccompProfile: { type: RuntimeDefault }
  {{- with .runtimeClassName }}
  runtimeClassName: {{ . }}
  {{- end }}
  # The preStop pause, the drain timeout and a margin of ten seconds.
  terminationGracePeriodSeconds: 45
  topologySpreadConstraints:
    - maxSkew: 1
      topologyKey: kubernetes.io/hostname
      whenUnsatisfiable: ScheduleAnyway
      labelSelector:
        matchLabels:
          {{- include "molmesh.labels" . | nindent 10 }}
  containers:
    - name: molmesh
      image: "{{ .root.Values.image.repository }}:{{ .tag }}"
      imagePullPolicy: {{ .root.Values.image.pullPolicy }}
      env:
        - { name: MOLMESH__SERVER__ROLE, value: {{ .role }} }
        {{- range $name, $value := .root.Values.environment }}
        - { name: {{ $name }}, value: {{ $value | quote }} }
        {{- end }}
        {{- with .jobs }}
        - { name: MOLMESH__JOBS__WORKERS, value: {{ . | quote }} }
        {{- end }}
        {{- with .root.Values.broker.secret }}
        - name: MOLMESH__BROKER__USER
          valueFrom:
            secretKeyRef: { name: {{ . }}, key: user }
        - name: MOLMESH__BROKER__PASSWORD
          valueFrom:
            secretKeyRef: { name: {{ . }}, key: password }
        {{- end }}
        {{- with .root.Values.store.secret }}
        - name: AWS_ACCESS_KEY_ID
          valueFrom:
            secretKeyRef: { name: {{ . }}, key: access-key-id }
        - name: AWS_SECRET_ACCESS_KEY
          valueFrom:
            secretKeyRef: { name: {{ . }}, key: secret-access-key }
        {{- end }}
      ports:
        - { name: http, containerPort: 8080 }
        - { name: metrics, containerPort: 9090 }
      securityContext:
        allowPrivilegeEscalation: false
        readOnlyRootFilesystem: true
        capabilities: { drop: [ALL] }
      resources:
        {{- toYaml .resources | nindent 8 }}
      # Answers once the store is open. The first mesh and the records of jobs are a matter of readiness: however long
      # they take, the pod is not killed.
      startupProbe:
        httpGet: { path: /livez, port: http }
        periodSeconds: 1
        timeoutSeconds: 2
        failureThreshold: 120
      readinessProbe:
        # A node without its queue still answers, so it stays behind the service.
        httpGet: { path: {{ if eq .role "api" }}/livez{{ else }}/readyz{{ end }}, port: http }
        periodSeconds: 5
        timeoutSeconds: 2
        failureThreshold: 2
      livenessProbe:
        httpGet: { path: /livez, port: http }
        periodSeconds: 10
        timeoutSeconds: 5
        failureThreshold: 3
      lifecycle:
        # A terminating pod receives requests until its endpoints are updated.
        preStop:
          sleep: { seconds: 10 }
      volumeMounts:
        - { name: data, mountPath: /data }
        - { name: configuration, mountPath: /etc/molmesh, readOnly: true }
        - { name: tmp, mountPath: /tmp }
        - { name: keys, mountPath: /etc/molmesh-keys, readOnly: true }
  volumes:
    # Copies of archive entries, and temporary files within limits.scratch_bytes.
    - name: data
      emptyDir: { sizeLimit: 9Gi }
    - name: configuration
      configMap: { name: {{ .root.Release.Name }} }
    - name: tmp
      emptyDir: { medium: Memory, sizeLimit: 16Mi }
    - name: keys
      secret: { secretName: {{ .root.Values.keysSecret }}, defaultMode: 0400 }
{{- end }}
