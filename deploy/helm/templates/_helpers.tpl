{{- define "warpfactor.name" -}}{{ .Release.Name | trunc 40 | trimSuffix "-" }}{{- end }}

{{- define "warpfactor.labels" -}}
app.kubernetes.io/name: warpfactor
app.kubernetes.io/instance: {{ .Release.Name }}
app.kubernetes.io/version: {{ .Chart.AppVersion | quote }}
app.kubernetes.io/managed-by: {{ .Release.Service }}
{{- end }}

{{- define "warpfactor.selector" -}}
app.kubernetes.io/name: warpfactor
app.kubernetes.io/instance: {{ .root.Release.Name }}
app.kubernetes.io/component: {{ .component }}
{{- end }}

{{- define "warpfactor.image" -}}
image: "{{ .Values.image.repository }}:{{ .Values.image.tag | default .Chart.AppVersion }}"
imagePullPolicy: {{ .Values.image.pullPolicy }}
{{- end }}

{{- define "warpfactor.podSecurity" -}}
runAsNonRoot: true
runAsUser: 10001
runAsGroup: 10001
fsGroup: 10001
seccompProfile: { type: RuntimeDefault }
{{- end }}

{{- define "warpfactor.containerSecurity" -}}
allowPrivilegeEscalation: false
readOnlyRootFilesystem: true
capabilities: { drop: [ALL] }
{{- end }}

{{- define "warpfactor.protocol" -}}{{ ternary "tls" "tcp" .Values.tls.enabled }}{{- end }}

{{- define "warpfactor.pooled" -}}
{{- if or .Values.pool.scale.enabled (gt (int .Values.pool.workers) 0) }}yes{{ end }}
{{- end }}

{{- define "warpfactor.probes" -}}
startupProbe:
  httpGet: { path: /healthy, port: metrics }
  periodSeconds: 5
  failureThreshold: 60
livenessProbe:
  httpGet: { path: /healthy, port: metrics }
  periodSeconds: 20
  timeoutSeconds: 5
  failureThreshold: 3
readinessProbe:
  httpGet: { path: /healthy, port: metrics }
  periodSeconds: 10
  timeoutSeconds: 5
{{- end }}

{{- define "warpfactor.egress" -}}
- ports:  # names
    - { protocol: UDP, port: 53 }
    - { protocol: TCP, port: 53 }
{{- if .pooled }}
- to:
    - podSelector:
        matchLabels: {{- include "warpfactor.selector" (dict "root" .root "component" "router") | nindent 10 }}
  ports:
    - { protocol: TCP, port: 7447 }
{{- end }}
{{- end }}
