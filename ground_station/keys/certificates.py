"""X.509 certificates and the other keys of a machine, as bytes; nothing here touches a file.

Keys are EC P-256, which rustls (Zenoh's TLS) takes. Certificates are valid from 1970 on: a board
without a battery-backed clock boots in the past and must still be spoken to. RFC 5280 profile: the
authority may sign certificates only, a machine's may open and answer TLS only.
"""

from __future__ import annotations

import datetime
import secrets
from dataclasses import dataclass

from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec, ed25519
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from ground_station.errors import KeysError

VALID_FROM = datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
# GStreamer's srtpenc takes key and salt as one: 16 and 14 bytes for AES-128 (RFC 3711, 8.2).
SRTP_KEY_BYTES = 30


@dataclass(frozen=True)
class Pair:
    """A certificate and its private key, both PEM."""

    certificate: bytes
    key: bytes


def make_authority(name: str, until: datetime.datetime) -> Pair:
    """A self-signed authority that may sign machines' certificates and nothing else."""
    key = ec.generate_private_key(ec.SECP256R1())
    builder = _builder(name, key, until).issuer_name(_name(name))
    usage = x509.KeyUsage(
        digital_signature=False, key_cert_sign=True, crl_sign=False, content_commitment=False,
        key_encipherment=False, data_encipherment=False, key_agreement=False,
        encipher_only=False, decipher_only=False,
    )  # fmt: skip
    builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
    builder = builder.add_extension(usage, critical=True)
    return _pair(builder.sign(key, hashes.SHA256()), key)


def make_certificate(name: str, authority: Pair, until: datetime.datetime) -> Pair:
    """A machine's certificate, for both ends of TLS, signed by the authority."""
    signer = serialization.load_pem_private_key(authority.key, None)
    if not isinstance(signer, ec.EllipticCurvePrivateKey):
        raise KeysError("the authority's key is not on an elliptic curve")
    issuer = x509.load_pem_x509_certificate(authority.certificate)
    until = min(until, issuer.not_valid_after_utc)
    key = ec.generate_private_key(ec.SECP256R1())
    both = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
    builder = _builder(name, key, until).issuer_name(issuer.subject)
    builder = builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), True)
    builder = builder.add_extension(x509.SubjectAlternativeName([x509.DNSName(name)]), False)
    builder = builder.add_extension(x509.ExtendedKeyUsage(both), False)
    return _pair(builder.sign(signer, hashes.SHA256()), key)


def inspect(certificate: bytes, authorities: bytes) -> tuple[str, datetime.datetime]:
    """Common name and end of a certificate; raises `KeysError` when no authority signed it."""
    try:
        read = x509.load_pem_x509_certificate(certificate)
        signers = x509.load_pem_x509_certificates(authorities)
        name = read.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value
    except (ValueError, IndexError):
        raise KeysError("it is no PEM certificate with a common name") from None
    for signer in signers:
        try:
            read.verify_directly_issued_by(signer)
        except Exception:  # not this one: the library tells in three ways
            continue
        return str(name), read.not_valid_after_utc
    raise KeysError("none of the trusted authorities signed it")


def check_key(pair: Pair) -> None:
    """Raises `KeysError` when the private key is not the one that the certificate was made for."""
    spki = (serialization.Encoding.DER, serialization.PublicFormat.SubjectPublicKeyInfo)
    try:
        certified = x509.load_pem_x509_certificate(pair.certificate).public_key()
        private = serialization.load_pem_private_key(pair.key, None)
    except (ValueError, TypeError, UnsupportedAlgorithm):
        raise KeysError("its key or certificate is not readable PEM") from None
    if private.public_key().public_bytes(*spki) != certified.public_bytes(*spki):
        raise KeysError("the private key is not the certificate's")


def make_srtp_key() -> bytes:
    """A master key with its salt, as one line of hexadecimal digits."""
    return secrets.token_hex(SRTP_KEY_BYTES).encode() + b"\n"


def make_ssh_key() -> tuple[bytes, bytes]:
    """An Ed25519 key for SSH: private in OpenSSH's format, and the public line."""
    key = ed25519.Ed25519PrivateKey.generate()
    private = key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.OpenSSH,
        serialization.NoEncryption(),
    )
    public = key.public_key().public_bytes(
        serialization.Encoding.OpenSSH, serialization.PublicFormat.OpenSSH
    )
    return private, public + b"\n"


def _name(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _builder(
    name: str, key: ec.EllipticCurvePrivateKey, until: datetime.datetime
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(_name(name))
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(VALID_FROM)
        .not_valid_after(until)
    )


def _pair(certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey) -> Pair:
    pem = serialization.Encoding.PEM
    private = key.private_bytes(
        pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    return Pair(certificate.public_bytes(pem), private)
