# SPDX-License-Identifier: Apache-2.0
"""What `openarm COMMAND` does: a module for each command or group of commands."""
