#!/usr/bin/env bash
# Checks of the CUDA variants on a machine with an NVIDIA GPU: agreement with LLVM, torch CUDA tensors without a copy, speed.
# Usage: benchmarks/gpu_check.sh [--cases] [--quick] [--json REPORT.json]     (PYTHON names the interpreter, python3 unless set)
#   --cases: small cases of the whole library instead (gpu_cases.py), which may be named behind it.
#   --variant llvm_ad_rgb (with --cases: llvm_ad): LLVM with itself, which needs no GPU.
# Exit code 0: every check passed. 1: a check failed. 3: no usable GPU.
set -euo pipefail
here="$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)"
python="${PYTHON:-python3}"
script=gpu_check.py
needs_gpu=yes
case " $* " in *" --variant llvm"* | *" --variant=llvm"*) needs_gpu=no ;; esac
arguments=()
for argument in "$@"; do
    if [ "$argument" = --cases ]; then script=gpu_cases.py; else arguments+=("$argument"); fi
done

if [ "$needs_gpu" = yes ]; then
    if ! command -v nvidia-smi >/dev/null || ! nvidia-smi -L >/dev/null 2>&1; then
        echo "gpu_check: no NVIDIA GPU was found (nvidia-smi is missing or lists none); run this on a machine that has one." >&2
        exit 3
    fi
    nvidia-smi -L
    if ! "$python" -c 'import torch, sys; sys.exit(not torch.cuda.is_available())'; then
        echo "gpu_check: torch has no CUDA here; install a torch build with CUDA (the default constraints take the CPU build)." >&2
        exit 3
    fi
fi
exec "$python" "$here/$script" ${arguments[@]+"${arguments[@]}"}
